"""What is gathered from the crossings of a ray: an image, its adjoint, responses of hat functions?

Every kernel runs in every tracer (Dr.Jit).
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
