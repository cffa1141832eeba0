"""What do Gmsh's files look like, in formats 2, 4.0 and 4.1, as text and binary?"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
