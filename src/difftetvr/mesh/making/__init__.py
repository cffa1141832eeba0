"""Where do meshes come from: boxes, points, surfaces, other cells, and files that are almost valid?

Each gives arrays that :class:`~difftetvr.TetMesh` accepts, or a sentence that says why it cannot.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
