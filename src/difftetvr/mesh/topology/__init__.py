"""Which cells, faces, edges and vertices of a mesh meet, as flat arrays?

All follows from one sort of the cells' faces; nothing here knows positions.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
