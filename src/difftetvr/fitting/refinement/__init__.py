"""When and where is a mesh refined?

Strategies, and the predictions that they go by; one of your own follows :class:`Strategy`.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
