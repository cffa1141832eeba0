from . import backend as backend
from . import capture as capture
from . import cli as cli
from . import errors as errors
from . import files as files
from . import fitting as fitting
from . import inverse as inverse
from . import mesh as mesh
from . import optics as optics
from . import recording as recording
from . import rendering as rendering
from . import sampling as sampling
from . import trust as trust
from . import view as view
from ._version import __version__ as __version__
from .capture.capture import Capture as Capture
from .capture.loading import load_capture as load_capture
from .capture.photos.photo_capture import PhotoCapture as PhotoCapture
from .capture.volumes.volume import Volume as Volume
from .capture.volumes.volume_capture import VolumeCapture as VolumeCapture
from .errors import BackendError as BackendError
from .errors import CameraError as CameraError
from .errors import CaptureError as CaptureError
from .errors import DiffTetError as DiffTetError
from .errors import FitError as FitError
from .errors import MeshError as MeshError
from .fitting.config import FitConfig as FitConfig
from .fitting.loop import fit as fit
from .fitting.records.result import FitResult as FitResult
from .inverse.transfer.fit import fit_transfer as fit_transfer
from .inverse.viewpoint.search import best_viewpoint as best_viewpoint
from .mesh.field import Field as Field
from .mesh.io.loading import MeshData as MeshData
from .mesh.io.loading import load as load
from .mesh.io.loading import load_data as load_data
from .mesh.io.loading import load_mesh as load_mesh
from .mesh.io.saving import save as save
from .mesh.tetmesh import TetMesh as TetMesh
from .optics.transfer_function import TransferFunction as TransferFunction
from .rendering.api import RenderedImage as RenderedImage
from .rendering.api import render as render
from .rendering.cameras.detector import Detector as Detector
from .rendering.cameras.lens import LensCamera as LensCamera
from .rendering.cameras.panoramic import PanoramicCamera as PanoramicCamera
from .rendering.cameras.parallel import ParallelCamera as ParallelCamera
from .rendering.cameras.pinhole import Camera as Camera
from .rendering.cell_features import CellFeatures as CellFeatures
from .rendering.quantities.along_rays import depth_at as depth_at
from .rendering.quantities.along_rays import transmittance_at as transmittance_at
from .rendering.quantities.normals import render_normals as render_normals
from .rendering.quantities.shading import render_shading as render_shading
from .rendering.rays import Rays as Rays
from .rendering.rays import RaySource as RaySource
from .rendering.scalar_field import ScalarField as ScalarField
from .sampling.grid_files import save_grid as save_grid
from .sampling.isosurfaces import isosurface as isosurface
from .sampling.probing import probe as probe
from .sampling.slabs import voxelise_to_file as voxelise_to_file
from .sampling.surface_files import save_surface as save_surface
from .sampling.voxels import voxelise as voxelise
from .trust import trusting as trusting

__all__ = [
    "BackendError",
    "Camera",
    "CameraError",
    "Capture",
    "CaptureError",
    "CellFeatures",
    "Detector",
    "DiffTetError",
    "Field",
    "FitConfig",
    "FitError",
    "FitResult",
    "LensCamera",
    "MeshData",
    "MeshError",
    "PanoramicCamera",
    "ParallelCamera",
    "PhotoCapture",
    "RaySource",
    "Rays",
    "RenderedImage",
    "ScalarField",
    "TetMesh",
    "TransferFunction",
    "Volume",
    "VolumeCapture",
    "__version__",
    "best_viewpoint",
    "depth_at",
    "fit",
    "fit_transfer",
    "isosurface",
    "load",
    "load_capture",
    "load_data",
    "load_mesh",
    "probe",
    "render",
    "render_normals",
    "render_shading",
    "save",
    "save_grid",
    "save_surface",
    "transmittance_at",
    "trusting",
    "voxelise",
    "voxelise_to_file",
]
