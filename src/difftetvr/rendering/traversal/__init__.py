"""What happens where a ray crosses one cell: exact predicates, one step of the walk, and what a crossing is?

The common ground of tracers and kernels (Dr.Jit).
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
