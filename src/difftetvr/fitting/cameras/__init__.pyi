from . import alignment as alignment
from . import curvature as curvature
from . import options as options
from . import refined as refined
from .options import CameraRefinement as CameraRefinement
from .refined import RefinedCameras as RefinedCameras

__all__ = ["CameraRefinement", "RefinedCameras"]
