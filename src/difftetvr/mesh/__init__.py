"""What is a tetrahedral mesh, what is known about it, and how far may its vertices move?

Positions, cells and the field on them stand here; inner rooms hold how cells meet (`topology`), where meshes come from
(`making`), how their cells change (`changes`) and their files (`io`).
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
