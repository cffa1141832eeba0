"""What is a field's value at a place: at points, on a grid of voxels, on the surface where it has a level?

Derivatives go to values, vertices and points, as far as they have a meaning.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
