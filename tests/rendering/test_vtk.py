"""Images against VTK's ray-cast mapper, which shares the optical model and nothing else."""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from oracle.scenes import SCENES

from difftetvr.mesh import Field, TetMesh
from difftetvr.mesh.io import load_data
from difftetvr.optics import TransferFunction
from difftetvr.rendering import ScalarField, render
from difftetvr.rendering.cameras.pinhole import Camera

pytest.importorskip("vtk", reason="VTK is not installed (extra `vtk`)")


@pytest.fixture(scope="module")
def vtk_scene() -> ModuleType:
    path = Path(__file__).parents[2] / "benchmarks" / "vtk_scene.py"
    spec = importlib.util.spec_from_file_location("vtk_scene", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if not module.can_render_offscreen():
        pytest.skip("VTK cannot open an off-screen window here (no EGL, OSMesa or display)")
    return module


@pytest.mark.parametrize("name", ["jittered", "grid", "delaunay", "porous", "components"])
def test_image_agrees_with_vtk(vtk_scene: ModuleType, name: str) -> None:
    """Seen from afar, because VTK's interpolation on faces knows no perspective."""
    scene, distance = SCENES[name](), 10.0
    eye = distance * torch.nn.functional.normalize(scene.camera.position, dim=0)
    fov = 2.0 * math.atan(0.6 / distance)
    camera = Camera.look_at(eye, (0.02, 0.03, -0.01), (0.1, 0.2, 1.0), fov, 160, 120)
    mesh, field = TetMesh(scene.vertices, scene.tets), Field(scene.color, scene.density)
    view = vtk_scene.VtkView(vtk_scene.ray_cast_mapper(vtk_scene.unstructured_grid(mesh, field)), camera, 8.0, 12.0)
    view.render()
    ours = vtk_scene.displayed(render(mesh, field, vtk_scene.ray_camera(camera)).color.numpy())
    difference = np.abs(ours - view.image())
    assert ours.mean() > 0.1
    assert difference.mean() < 0.5 / 255.0
    # VTK truncates to 8 bits before it interpolates, and the window rounds again.
    assert difference.max() < 3.0 / 255.0


@pytest.mark.parametrize(
    ("name", "scalar"),
    [
        ("bluntfin.npz", "density"),
        ("oxygen-post.npz", "energy"),
        ("post.vtk", "Pressure"),
        ("tetraMesh.vtk", "scalars"),
    ],
)
def test_simulations_agree_with_vtk(vtk_scene: ModuleType, shared_data: Path, name: str, scalar: str) -> None:
    """Real meshes, with flat cells and non-convex bounds, through a transfer function."""
    data = load_data(shared_data / "meshes" / name, flat="drop")
    mesh, values = data.mesh, data.point_data[scalar]
    lower, upper = mesh.bounds()
    size, center = float((upper - lower).max()), 0.5 * (lower + upper)
    field = ScalarField(
        values, TransferFunction.default(), 25.0 / size, (float(values.min()), float(values.max())), "vertex"
    )
    distance = 10.0 * size
    eye = center + distance * torch.nn.functional.normalize(torch.tensor([0.45, -1.0, 0.6]), dim=0)
    camera = Camera.look_at(eye, center, (0.0, 0.0, 1.0), 2.0 * math.atan(0.06), 160, 120)
    mapper = vtk_scene.ray_cast_mapper(vtk_scene.scalar_grid(mesh, values))
    view = vtk_scene.VtkView(mapper, camera, distance - size, distance + size)
    view.show_scalar(field)
    view.render()
    ours = vtk_scene.displayed(render(mesh, field, vtk_scene.ray_camera(camera)).color.numpy())
    difference = np.abs(ours - view.image())
    assert ours.max() > 0.1
    assert difference.mean() < 0.5 / 255.0
    assert difference.max() < 3.0 / 255.0
