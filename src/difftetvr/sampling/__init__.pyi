from . import gltf as gltf
from . import grid_files as grid_files
from . import grids as grids
from . import interpolation as interpolation
from . import isosurfaces as isosurfaces
from . import location as location
from . import nifti as nifti
from . import probing as probing
from . import slabs as slabs
from . import surface_files as surface_files
from . import voxels as voxels
from .grid_files import save_grid as save_grid
from .grids import Grid as Grid
from .isosurfaces import isosurface as isosurface
from .probing import probe as probe
from .slabs import voxelise_to_file as voxelise_to_file
from .surface_files import save_surface as save_surface
from .voxels import voxelise as voxelise

__all__ = ["Grid", "isosurface", "probe", "save_grid", "save_surface", "voxelise", "voxelise_to_file"]
