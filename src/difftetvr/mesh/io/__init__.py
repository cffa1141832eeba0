"""How do meshes with their data come from files and go into them?

A file holds the vertices, the tetrahedra and the field as point or cell data named ``color`` (3 components, linear RGB)
and ``density`` (>= 0, per unit length), so ParaView and pyvista show it as it is.

Whatever a file holds, reading it gives a valid mesh or a :class:`~difftetvr.MeshError`: every number that a file
announces is compared with its size before anything is allocated.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
