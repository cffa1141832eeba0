from . import camera_paths as camera_paths
from . import camera_set as camera_set
from . import capture as capture
from . import capture_file as capture_file
from . import degenerate as degenerate
from . import free_space as free_space
from . import hull as hull
from . import loading as loading
from . import orbit as orbit
from . import packed as packed
from . import photos as photos
from . import projections as projections
from . import viewing as viewing
from . import volumes as volumes
from .camera_set import CameraSet as CameraSet
from .capture import Capture as Capture
from .loading import load_cameras as load_cameras
from .loading import load_capture as load_capture
from .orbit import fibonacci_orbit as fibonacci_orbit
from .orbit import random_orbit as random_orbit
from .packed import MixedImages as MixedImages
from .packed import PackedImages as PackedImages
from .photos.photo_capture import PhotoCapture as PhotoCapture
from .photos.photo_capture import is_photo_source as is_photo_source
from .photos.photo_set import CaptureWarning as CaptureWarning
from .projections.geometry import ProjectionGeometry as ProjectionGeometry
from .projections.naming import is_projection_source as is_projection_source
from .projections.noise import Noise as Noise
from .projections.projection_capture import ProjectionCapture as ProjectionCapture
from .projections.projector import project_volume as project_volume
from .volumes.volume import Volume as Volume
from .volumes.volume import is_volume_file as is_volume_file
from .volumes.volume_capture import TOOTH as TOOTH
from .volumes.volume_capture import VolumeCapture as VolumeCapture
from .volumes.volume_renderer import VolumeRenderer as VolumeRenderer
from .volumes.voxels import VoxelVolume as VoxelVolume
from .volumes.voxels import load_volume as load_volume

__all__ = [
    "TOOTH",
    "CameraSet",
    "Capture",
    "CaptureWarning",
    "MixedImages",
    "Noise",
    "PackedImages",
    "PhotoCapture",
    "ProjectionCapture",
    "ProjectionGeometry",
    "Volume",
    "VolumeCapture",
    "VolumeRenderer",
    "VoxelVolume",
    "fibonacci_orbit",
    "is_photo_source",
    "is_projection_source",
    "is_volume_file",
    "load_cameras",
    "load_capture",
    "load_volume",
    "project_volume",
    "random_orbit",
]
