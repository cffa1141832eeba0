from . import key_cameras as key_cameras
from . import path_file as path_file
from . import rounds as rounds
from . import spline as spline
from .key_cameras import key_cameras_of as key_cameras_of
from .path_file import CameraPath as CameraPath
from .path_file import load_camera_path as load_camera_path
from .path_file import save_camera_path as save_camera_path
from .rounds import ellipse as ellipse
from .rounds import turntable as turntable
from .spline import interpolated as interpolated

__all__ = [
    "CameraPath",
    "ellipse",
    "interpolated",
    "key_cameras_of",
    "load_camera_path",
    "save_camera_path",
    "turntable",
]
