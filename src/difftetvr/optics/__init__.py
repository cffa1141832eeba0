"""What does light do inside one cell: weights of the end colours, transmittance, and their adjoints?

Models of a crossing, and transfer functions.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
