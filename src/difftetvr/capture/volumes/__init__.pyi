from . import orientation as orientation
from . import readers as readers
from . import stored as stored
from . import summary as summary
from . import value_range as value_range
from . import volume as volume
from . import volume_capture as volume_capture
from . import volume_file as volume_file
from . import volume_kernel as volume_kernel
from . import volume_renderer as volume_renderer
from . import voxels as voxels
from .volume import Volume as Volume
from .volume_capture import VolumeCapture as VolumeCapture
from .volume_renderer import VolumeRenderer as VolumeRenderer
from .voxels import VoxelVolume as VoxelVolume
from .voxels import load_volume as load_volume

__all__ = ["Volume", "VolumeCapture", "VolumeRenderer", "VoxelVolume", "load_volume"]
