"""Which views do the files of a capture describe: NeRF-synthetic, nerfstudio, COLMAP, our own, tiny NeRF?

Each returns a :class:`~difftetvr.capture.photos.photo_set.PhotoSet`; no image is decoded yet.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
