"""What happens where a ray crosses one cell: exact predicates, one step of the walk, and what a crossing is?

The common ground of tracers and kernels (Dr.Jit).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
