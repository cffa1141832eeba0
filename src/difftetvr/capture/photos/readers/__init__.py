"""Which views do the files of a capture describe: those of NeRF, nerfstudio, COLMAP, phones, our own?

Each returns a :class:`~difftetvr.capture.photos.photo_set.PhotoSet`; no image is decoded yet.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
