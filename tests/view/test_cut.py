"""Cuts through meshes, and sheets that compare models."""

import dataclasses

import numpy as np
import pytest
import torch
from PIL import Image

from difftetvr.capture import VolumeCapture
from difftetvr.errors import CaptureError, MeshError
from difftetvr.fitting.records.history import History, RefinementRecord
from difftetvr.mesh import Field, TetMesh
from difftetvr.view.compare import Model, compare_models
from difftetvr.view.cut import Plane, cut_picture
from difftetvr.view.plots import save_curves

DENSE = 1e6  # so opaque that a slab shows its colour


def pixels(picture):
    return np.asarray(picture).astype(float) / 255.0


def test_a_cut_shows_linear_colours_where_they_are():
    mesh = TetMesh.grid((3, 4, 5), lower=(-1.0, 0.0, 2.0), upper=(1.0, 1.0, 4.0))
    y, z = mesh.vertices[:, 1], mesh.vertices[:, 2]
    color = torch.stack((y, (z - 2) / 2, torch.full_like(y, 0.25)), 1)
    field = Field(color, torch.full_like(y, DENSE))
    shown = pixels(cut_picture(mesh, field, Plane((1.0, 0.0, 0.0)), size=201, outlines=False))
    assert shown.shape == (201, 101, 3)  # z is up and twice as long as y
    rows, columns = np.mgrid[0:201, 0:101]
    expected = np.stack((columns / 100, 1 - rows / 200, np.full_like(rows, 0.25, dtype=float)), 2)
    assert np.abs(shown - expected).max() < 0.01, "every pixel belongs to a cell"


def test_a_cut_off_the_centre_and_across():
    mesh = TetMesh.grid((2, 2, 2))
    color = mesh.vertices[:, [0, 0, 0]].contiguous()
    field = Field(color, torch.full((mesh.num_vertices,), DENSE))
    shown = pixels(cut_picture(mesh, field, Plane((2.0, 0.0, 0.0), origin=(0.3, 0.5, 0.5)), size=32, outlines=False))
    assert np.abs(shown - 0.3).max() < 0.01
    seen = pixels(cut_picture(mesh, field, Plane((1.0, -1.0, 0.0)), size=64, outlines=False))
    assert seen.shape[1] == 64 > seen.shape[0] > 40, "a diagonal plane is wider than high"


def test_colours_of_cells_and_transparency():
    mesh = TetMesh.grid((4, 4, 4))
    centers = mesh.vertices[mesh.tets.long()].mean(1)
    left = (centers[:, 1] < 0.5).float()
    field = Field(torch.ones(mesh.num_cells, 3), DENSE * left, location="cell")
    shown = pixels(cut_picture(mesh, field, size=101, outlines=False))
    assert shown[:, :45].min() == 1.0
    assert shown[:, 56:].max() == 0.0


def test_outlines_lie_on_the_cells_faces():
    mesh = TetMesh.grid((1, 1, 1))
    field = Field(torch.zeros(8, 3), torch.zeros(8))
    drawn = pixels(cut_picture(mesh, field, Plane((0.0, 0.0, 1.0)), size=101)).max(2)
    assert drawn[0].min() > 0.1 and drawn[:, 0].min() > 0.1, "the box's outline"
    assert 0.02 < (drawn > 0.05).mean() < 0.2


def test_cuts_that_cannot_be():
    mesh = TetMesh.grid((1, 1, 1))
    field = Field(torch.zeros(8, 3), torch.zeros(8))
    with pytest.raises(MeshError, match="misses the mesh"):
        cut_picture(mesh, field, Plane(origin=(7.0, 0.0, 0.0)))
    with pytest.raises(MeshError, match="normal of the cut"):
        cut_picture(mesh, field, Plane((0.0, 0.0, 0.0)))


@pytest.fixture(scope="module")
def capture():
    return VolumeCapture(views=10, width=24, height=24, steps_per_unit=300.0).build()


def test_models_stand_beside_the_truth(capture):
    lower, upper = capture.bounds.tolist()
    models = []
    for name, cubes in (("coarse", (2, 2, 3)), ("fine", (4, 4, 6))):
        mesh = TetMesh.grid(cubes, lower, upper)
        models.append(Model(name, mesh, Field(torch.rand(mesh.num_vertices, 3), torch.rand(mesh.num_vertices))))
    sheet = compare_models(capture, models, rows=2, plane=Plane())
    assert sheet.width > 3 * 384 and sheet.height > 3 * 384
    assert sheet.height > compare_models(capture, models, rows=2).height
    assert compare_models(capture, models[:1], rows=99).height > 384 * 2, "no more rows than held-out views"
    with pytest.raises(CaptureError, match="show at least 1"):
        compare_models(capture, models, rows=0)


def test_curves_gain_a_plot_of_predicted_and_achieved_gains(tmp_path):
    history = History([0.1] * 9, [10.0] * 9)
    save_curves(tmp_path / "plain.png", history)
    for k, achieved in enumerate((3e-4, -1e-5)):
        history.refinements.append(RefinementRecord(k, 90, 100, 40, 3, 4, 5, 4e-4, 1e-3, 1e-3 - achieved))
    save_curves(tmp_path / "gains.png", history)
    plain, gains = (Image.open(tmp_path / name) for name in ("plain.png", "gains.png"))
    assert gains.width == 1.5 * plain.width


def test_views_without_valid_pixels_are_not_compared(capture):
    tested = capture.test_indices.tolist()
    valid = torch.ones(capture.images.shape[:3], dtype=torch.bool)
    valid[tested[-1]] = False
    masked = dataclasses.replace(capture, valid=valid)
    mesh = TetMesh.grid((2, 2, 2), *capture.bounds.tolist())
    field = Field(torch.full((mesh.num_vertices, 3), 0.5), torch.ones(mesh.num_vertices))
    models = [Model("grey", mesh, field)]
    all_rows, fewer = (compare_models(views, models, rows=99).height for views in (capture, masked))
    assert fewer < all_rows


def test_a_background_shows_through_the_slab_and_beside_it_with_dark_lines_on_light():
    mesh = TetMesh.grid((1, 1, 1))
    thin = Field(torch.full((8, 3), 0.5), torch.full((8,), 1e-6))
    white = (1.0, 1.0, 1.0)
    assert pixels(cut_picture(mesh, thin, size=64, outlines=False, background=white)).min() > 0.99
    opaque = Field(torch.full((8, 3), 0.5), torch.full((8,), 1e6))
    assert abs(pixels(cut_picture(mesh, opaque, size=64, outlines=False, background=white)) - 0.5).max() < 0.01
    drawn = pixels(cut_picture(mesh, thin, size=64, background=white))
    assert drawn.min() < 0.7, "outlines must show on white"


def test_colours_of_cells_stay_apart_where_a_mesh_has_as_many_vertices_as_cells():
    mesh = TetMesh.grid((2, 1, 1))
    assert mesh.num_cells == mesh.num_vertices
    color = torch.linspace(0.0, 1.0, mesh.num_cells)[:, None].expand(-1, 3)
    field = Field(color, torch.full((mesh.num_cells,), DENSE), location="cell")
    shown = cut_picture(mesh, field, Plane((0.0, 0.0, 1.0)), size=64, outlines=False)
    assert len(shown.getcolors()) <= mesh.num_cells + 1
