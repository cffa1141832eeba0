"""Which views do the files of a capture describe: NeRF-synthetic, nerfstudio, COLMAP, our own, tiny NeRF?

Each returns a :class:`~difftetvr.capture.photos.photo_set.PhotoSet`; no image is decoded yet.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
