"""How strongly did something absorb along known rays? Projections of tomographs, their geometry, and their noise.

Measured ones from files, and those that are made from a volume of voxels.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
