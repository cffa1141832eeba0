"""What is gathered from the crossings of a ray: an image, its adjoint, responses of hat functions?

Every kernel runs in every tracer (Dr.Jit).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
