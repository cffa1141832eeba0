"""Through which half-faces does a ray enter cells?

Those of a camera are rasterised, those of other rays looked for in hierarchies of boxes, by one exact rule.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
