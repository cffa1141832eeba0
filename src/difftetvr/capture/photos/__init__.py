"""How do photographs whose cameras are known become a capture: lenses, masks, sizes, the box that holds the scene?

`readers` finds views in the files of other programs; what is here decodes, undistorts and bounds them.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
