from . import api as api
from . import autograd as autograd
from . import cameras as cameras
from . import cell_features as cell_features
from . import clip_plane as clip_plane
from . import gauss_newton as gauss_newton
from . import inspection as inspection
from . import kernels as kernels
from . import preparation as preparation
from . import prepared_rays as prepared_rays
from . import quantities as quantities
from . import rays as rays
from . import scalar_field as scalar_field
from . import search as search
from . import tracers as tracers
from . import traversal as traversal
from . import viewpoints as viewpoints
from .api import RenderedImage as RenderedImage
from .api import render as render
from .cameras.camera_file import load_camera as load_camera
from .cameras.camera_file import save_camera as save_camera
from .cameras.detector import Detector as Detector
from .cameras.lens import LensCamera as LensCamera
from .cameras.panoramic import PanoramicCamera as PanoramicCamera
from .cameras.parallel import ParallelCamera as ParallelCamera
from .cameras.pinhole import Camera as Camera
from .cell_features import CellFeatures as CellFeatures
from .quantities.along_rays import depth_at as depth_at
from .quantities.along_rays import transmittance_at as transmittance_at
from .quantities.normals import render_normals as render_normals
from .quantities.shading import render_shading as render_shading
from .rays import Rays as Rays
from .rays import RaySource as RaySource
from .scalar_field import ScalarField as ScalarField
from .tracers.projected import OrderWarning as OrderWarning

__all__ = [
    "Camera",
    "CellFeatures",
    "Detector",
    "LensCamera",
    "OrderWarning",
    "PanoramicCamera",
    "ParallelCamera",
    "RaySource",
    "Rays",
    "RenderedImage",
    "ScalarField",
    "depth_at",
    "load_camera",
    "render",
    "render_normals",
    "render_shading",
    "save_camera",
    "transmittance_at",
]
