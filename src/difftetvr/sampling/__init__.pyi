from . import interpolation as interpolation
from . import isosurfaces as isosurfaces
from . import location as location
from . import probing as probing
from . import voxels as voxels
from .isosurfaces import isosurface as isosurface
from .probing import probe as probe
from .voxels import voxelise as voxelise

__all__ = ["isosurface", "probe", "voxelise"]
