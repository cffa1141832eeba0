"""How do the cells of a mesh change: bisection, collapse, flips, insertion, removal, star subdivision?

Each returns a :class:`~difftetvr.mesh.changes.change.MeshChange`: the new mesh, and how data is carried over to it.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
