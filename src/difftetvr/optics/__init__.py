"""What does light do inside one cell: weights of the end colours, transmittance, and their adjoints?

Models of a crossing, and transfer functions.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
