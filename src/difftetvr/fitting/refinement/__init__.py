"""When and where is a mesh refined?

Strategies, and the predictions that they go by; one of your own follows :class:`Strategy`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
