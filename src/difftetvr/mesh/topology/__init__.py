"""Which cells, faces, edges and vertices of a mesh meet, as flat arrays?

All follows from one sort of the cells' faces; nothing here knows positions.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
