"""Differentiable volume rendering of tetrahedral meshes.

From a mesh with colour and density and a camera to an image, and from the derivative of a loss on that image back to
colours, densities, vertex positions and camera poses; from images to an adaptive tetrahedral volume.
"""

from difftetvr.errors import BackendError, CameraError, CaptureError, DiffTetError, MeshError
from difftetvr.mesh import Field, TetMesh
from difftetvr.mesh.io import load, save
from difftetvr.render import Camera, RenderedImage, render

__all__ = [
    "BackendError",
    "Camera",
    "CameraError",
    "CaptureError",
    "DiffTetError",
    "Field",
    "MeshError",
    "RenderedImage",
    "TetMesh",
    "load",
    "render",
    "save",
]
