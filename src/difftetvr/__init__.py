"""Differentiable volume rendering of tetrahedral meshes.

From a mesh with colour and density and a camera to an image, and from the derivative of a loss on that image back to
colours, densities, transfer functions, vertex positions and camera poses; from images to a tetrahedral volume.
"""

from difftetvr.capture import Capture, TransferFunction, Volume, VolumeCapture, load_capture
from difftetvr.errors import BackendError, CameraError, CaptureError, DiffTetError, MeshError
from difftetvr.fit import FitConfig, FitError, FitResult, fit
from difftetvr.mesh import Field, TetMesh
from difftetvr.mesh.io import MeshData, load, load_data, load_mesh, save
from difftetvr.render import Camera, RenderedImage, ScalarField, render

__all__ = [
    "BackendError",
    "Camera",
    "CameraError",
    "Capture",
    "CaptureError",
    "DiffTetError",
    "Field",
    "FitConfig",
    "FitError",
    "FitResult",
    "MeshData",
    "MeshError",
    "RenderedImage",
    "ScalarField",
    "TetMesh",
    "TransferFunction",
    "Volume",
    "VolumeCapture",
    "fit",
    "load",
    "load_capture",
    "load_data",
    "load_mesh",
    "render",
    "save",
]
