from . import camera_file as camera_file
from . import checks as checks
from . import detector as detector
from . import intrinsics as intrinsics
from . import lens as lens
from . import lenses as lenses
from . import panoramic as panoramic
from . import parallel as parallel
from . import pinhole as pinhole
from . import pinhole_rays as pinhole_rays
from . import rigid as rigid
from .camera_file import load_camera as load_camera
from .camera_file import save_camera as save_camera
from .detector import Detector as Detector
from .lens import LensCamera as LensCamera
from .panoramic import PanoramicCamera as PanoramicCamera
from .parallel import ParallelCamera as ParallelCamera
from .pinhole import Camera as Camera

__all__ = [
    "Camera",
    "Detector",
    "LensCamera",
    "PanoramicCamera",
    "ParallelCamera",
    "load_camera",
    "save_camera",
]
