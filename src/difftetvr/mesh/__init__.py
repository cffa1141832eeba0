"""What is a tetrahedral mesh, what is known about it, and how far may its vertices move?

Positions, cells and the field on them stand here; inner rooms hold how cells meet (`topology`), where meshes come from
(`making`), how their cells change (`changes`) and their files (`io`).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
