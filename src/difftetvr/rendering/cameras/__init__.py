"""Which ray belongs to which pixel?

A camera holds extrinsics, intrinsics and the image's size, and is differentiable in its pose.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
