from . import bounds as bounds
from . import image_file as image_file
from . import lens as lens
from . import photo_capture as photo_capture
from . import photo_load as photo_load
from . import photo_set as photo_set
from . import poses as poses
from . import readers as readers
from . import undistort as undistort
from .photo_capture import PhotoCapture as PhotoCapture
from .photo_set import CaptureWarning as CaptureWarning

__all__ = ["CaptureWarning", "PhotoCapture"]
