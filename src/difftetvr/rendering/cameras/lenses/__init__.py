"""How do lenses bend directions?

Which models there are, what they do to coordinates, and back.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
