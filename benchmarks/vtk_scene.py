"""A tetrahedral mesh in VTK: its two volume mappers for linear colour and density, and our cameras.

VTK's ray-cast mapper integrates along each cell as ``ExactLinear`` does, by a table of the same integral ("partial
pre-integration"). Three things set its images apart: they are 8-bit and truncated, they are stretched by half a pixel
at either end on their way to the window (see :func:`displayed`), and where a ray crosses a face, colour and density are
interpolated without correction for perspective, which shows where a cell is large compared to its distance.
"""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import torch
import vtk
from scipy.ndimage import map_coordinates
from vtk.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray, vtk_to_numpy

from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import ScalarField
from difftetvr.rendering.cameras.pinhole import Camera

_PROBE = "import vtk; w = vtk.vtkRenderWindow(); w.SetOffScreenRendering(1); w.SetSize(8, 8); w.Render()"


def can_render_offscreen() -> bool:
    """Whether VTK can open an off-screen window here; asked of another process, because a failure may be a crash."""
    try:
        return subprocess.run([sys.executable, "-c", _PROBE], capture_output=True, timeout=120).returncode == 0
    except subprocess.TimeoutExpired:
        return False


def unstructured_grid(mesh: TetMesh, field: Field) -> vtk.vtkUnstructuredGrid:
    """The mesh with point data of four dependent components: linear RGB and density per unit length."""
    points = vtk.vtkPoints()
    points.SetData(numpy_to_vtk(mesh.vertices.detach().cpu().double().numpy(), deep=True))
    cells = vtk.vtkCellArray()
    tets = mesh.tets.cpu().numpy().astype(np.int64)
    cells.SetData(4, numpy_to_vtkIdTypeArray(tets.ravel(), deep=True))
    grid = vtk.vtkUnstructuredGrid()
    grid.SetPoints(points)
    grid.SetCells(vtk.VTK_TETRA, cells)
    values = torch.cat([field.color, field.density[:, None]], dim=1).detach().cpu().float().numpy()
    rgba = numpy_to_vtk(values, deep=True)
    rgba.SetName("rgba")
    grid.GetPointData().SetScalars(rgba)
    return grid


def scalar_grid(mesh: TetMesh, scalar: torch.Tensor) -> vtk.vtkUnstructuredGrid:
    """The mesh with a scalar as point data."""
    nothing = Field(torch.zeros(mesh.num_vertices, 3), torch.zeros(mesh.num_vertices))
    grid = unstructured_grid(mesh, nothing)
    values = numpy_to_vtk(scalar.detach().cpu().double().numpy(), deep=True)
    values.SetName("scalar")
    grid.GetPointData().SetScalars(values)
    return grid


def ray_cast_mapper(grid: vtk.vtkUnstructuredGrid) -> vtk.vtkUnstructuredGridVolumeMapper:
    """One ray a pixel, partial pre-integration."""
    mapper = vtk.vtkUnstructuredGridVolumeRayCastMapper()
    mapper.SetInputData(grid)
    mapper.SetRayIntegrator(vtk.vtkUnstructuredGridPartialPreIntegration())
    mapper.AutoAdjustSampleDistancesOff()
    mapper.SetImageSampleDistance(1.0)
    return mapper


def projected_tetrahedra_mapper(grid: vtk.vtkUnstructuredGrid) -> vtk.vtkUnstructuredGridVolumeMapper:
    """Sorted, projected and rasterised cells; on a machine without a GPU in Mesa's software rasteriser."""
    mapper = vtk.vtkProjectedTetrahedraMapper()
    mapper.SetInputData(grid)
    return mapper


class VtkView:
    """An off-screen window of a camera's size and view on a mapper's volume, over black."""

    def __init__(self, mapper: vtk.vtkUnstructuredGridVolumeMapper, camera: Camera, near: float, far: float) -> None:
        vtk.vtkLogger.SetStderrVerbosity(vtk.vtkLogger.VERBOSITY_OFF)
        appearance = vtk.vtkVolumeProperty()
        appearance.IndependentComponentsOff()
        appearance.ShadeOff()
        appearance.SetScalarOpacityUnitDistance(1.0)
        volume = vtk.vtkVolume()
        volume.SetProperty(appearance)
        volume.SetMapper(mapper)
        self._appearance = appearance
        renderer = vtk.vtkRenderer()
        renderer.SetBackground(0.0, 0.0, 0.0)
        renderer.AddVolume(volume)
        self._window = vtk.vtkRenderWindow()
        self._window.SetOffScreenRendering(1)
        self._window.SetMultiSamples(0)
        self._window.SetSize(camera.width, camera.height)
        self._window.AddRenderer(renderer)
        self._size = (camera.height, camera.width)
        self._camera = renderer.GetActiveCamera()
        self._camera.SetClippingRange(near, far)
        self.look(camera)

    def look(self, camera: Camera) -> None:
        """Take the pose and the (square) pixels of another camera of the same size."""
        pose = camera.world_to_camera.detach().cpu().double()
        rotation, eye = pose[:3, :3], -pose[:3, :3].T @ pose[:3, 3]
        self._camera.SetPosition(*eye.tolist())
        self._camera.SetFocalPoint(*(eye + rotation[2]).tolist())
        self._camera.SetViewUp(*(-rotation[1]).tolist())
        self._camera.SetViewAngle(math.degrees(2.0 * math.atan(0.5 * camera.height / camera.fy)))
        self._camera.SetWindowCenter(1.0 - 2.0 * camera.cx / camera.width, 2.0 * camera.cy / camera.height - 1.0)

    def show_scalar(self, field: ScalarField) -> None:
        """Colour and opacity from the transfer function of a scalar with a range."""
        assert field.value_range is not None
        low, high = field.value_range
        function = field.transfer_function
        color, opacity = vtk.vtkColorTransferFunction(), vtk.vtkPiecewiseFunction()
        color.SetColorSpaceToRGB()
        for knot, alpha, rgb in zip(function.scalar, function.opacity, function.color, strict=True):
            value = low + float(knot) * (high - low)
            color.AddRGBPoint(value, *rgb.tolist())
            opacity.AddPoint(value, float(alpha))
        self._appearance.IndependentComponentsOn()
        self._appearance.SetColor(color)
        self._appearance.SetScalarOpacity(opacity)
        self._appearance.SetScalarOpacityUnitDistance(1.0 / field.attenuation)

    def render(self) -> None:
        """Render the volume anew."""
        self._window.Render()

    def image(self) -> np.ndarray:
        """(H, W, 3) float64 image of the last rendering, the top row first."""
        grab = vtk.vtkWindowToImageFilter()
        grab.SetInput(self._window)
        grab.ReadFrontBufferOff()
        grab.Update()
        pixels = vtk_to_numpy(grab.GetOutput().GetPointData().GetScalars())
        return pixels.reshape(*self._size, 3)[::-1] / 255.0


def ray_camera(camera: Camera) -> Camera:
    """The camera whose rays VTK's ray-cast mapper sends: through the pixels' lower left corners."""
    pose, fx, fy = camera.world_to_camera, camera.fx, camera.fy
    return Camera(pose, fx, fy, camera.cx + 0.5, camera.cy - 0.5, camera.width, camera.height)


def displayed(image: np.ndarray) -> np.ndarray:
    """What VTK shows of an (H, W, 3) ray-cast image: its border pixels' centres are pulled to the window's border.

    (vtkRayCastImageDisplayHelper draws it as a texture from half a texel inside either end.)
    """
    height, width = image.shape[:2]
    rows = (np.arange(height) + 0.5) * (height - 1) / height
    columns = (np.arange(width) + 0.5) * (width - 1) / width
    grid = np.meshgrid(rows, columns, indexing="ij")
    return np.stack([map_coordinates(image[..., k], grid, order=1) for k in range(3)], axis=-1)
