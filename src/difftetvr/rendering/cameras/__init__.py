"""Which ray belongs to which pixel?

A camera holds extrinsics, intrinsics and the image's size, and is differentiable in all that is a tensor. Pinhole
cameras are rasterised; lenses, parallel and panoramic cameras and detectors are bundles of rays.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
