"""Meshes of the inside of surfaces: the real meshers where they are installed, a stand-in for what goes wrong."""

import contextlib
import os
import sys

import meshio
import numpy as np
import pytest
import torch

from difftetvr.errors import MeshError
from difftetvr.mesh import TetMesh
from difftetvr.mesh.io.formats import through_meshio
from difftetvr.mesh.making.surfaces import (
    MesherOptions,
    as_surface,
    load_surface,
    open_edges,
    tetrahedralize,
    tetrahedralize_box,
)

CUBE = np.array([[i & 1, i >> 1 & 1, i >> 2] for i in range(8)], dtype=float)
FACES = np.array(
    [
        *([0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4]),
        *([2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5]),
    ]
)
PACKAGES = {"ftetwild": "pytetwild", "tetgen": "tetgen"}
COARSE = MesherOptions(edge_length=0.4)

STAND_IN = """
import os, pathlib, numpy as np
pathlib.Path("litter.stl").write_text("left behind")
class TetGen:
    def __init__(self, points, faces):
        self.points = points
    def tetrahedralize(self, **options):
        MODE
        cells = np.array([[0, 1, 2, 4], [1, 2, 3, 7], [1, 4, 5, 7], [2, 4, 6, 7], [1, 2, 4, 7]], np.int32)
        return self.points, cells, np.ones((len(cells), 1)), None
"""


@pytest.fixture(params=PACKAGES)
def mesher(request):
    pytest.importorskip(PACKAGES[request.param])
    return request.param


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    """Puts a package named tetgen in place whose tetrahedralize runs some code first."""

    def install(mode="pass"):
        package = tmp_path / "packages"
        package.mkdir()
        (package / "tetgen.py").write_text(STAND_IN.replace("MODE", mode))
        monkeypatch.syspath_prepend(str(package))
        monkeypatch.delitem(sys.modules, "tetgen", raising=False)

    return install


def volume(mesh):
    return float(mesh.volumes().double().sum())


def test_meshes_are_valid_and_fill_the_inside(mesher):
    mesh = tetrahedralize(CUBE, FACES, mesher, COARSE)
    TetMesh(mesh.vertices, mesh.tets)
    assert mesh.vertices.dtype == torch.float32
    assert volume(mesh) == pytest.approx(1.0, rel=0.01)
    assert mesh.num_cells > 50


def test_cavities_stay_empty(mesher):
    inner = CUBE * 0.5 + 0.25
    mesh = tetrahedralize(np.concatenate((CUBE, inner)), np.concatenate((FACES, FACES[:, ::-1] + 8)), mesher, COARSE)
    assert volume(mesh) == pytest.approx(0.875, rel=0.01)


def test_boxes_of_a_number_of_cells_in_any_unit(mesher):
    lower, upper = (-2e-6, 0.0, 1e-6), (2e-6, 1e-6, 3e-6)
    mesh = tetrahedralize_box(lower, upper, mesher, MesherOptions(cells=600))
    assert 250 <= mesh.num_cells <= 1200  # fTetWild's numbers jump
    assert volume(mesh) == pytest.approx(8e-18, rel=0.01)
    assert torch.allclose(mesh.bounds().double(), torch.tensor([lower, upper]).double(), atol=1e-8)


def test_no_files_are_left_behind(mesher, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tetrahedralize(CUBE, FACES, mesher, COARSE)
    assert not list(tmp_path.iterdir())


def test_tetgen_refuses_what_intersects_itself():
    pytest.importorskip("tetgen")
    crossing = np.concatenate((CUBE, CUBE * 0.5 + [0.7, 0.3, 0.3]))
    with pytest.raises(MeshError, match=r"TetGen refuses the surface \(.*intersect.*\); repair it, or use fTetWild\.$"):
        tetrahedralize(crossing, np.concatenate((FACES, FACES + 8)), "tetgen", COARSE)


def test_a_stand_in_for_the_mesher_runs_in_a_folder_of_its_own(stand_in, tmp_path, monkeypatch):
    stand_in()
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    mesh = tetrahedralize(CUBE + 10, FACES, "tetgen", dtype=torch.float64)
    assert mesh.num_cells == 5
    assert volume(mesh) == pytest.approx(1.0)
    assert mesh.bounds().tolist() == [[10.0] * 3, [11.0] * 3]
    assert not list((tmp_path / "here").iterdir())


@pytest.mark.parametrize(
    ("mode", "message"),
    [
        (
            "raise RuntimeError('a facet\\n  crosses another.')",
            r"refuses the surface \(a facet crosses another\); repair",
        ),
        ("os._exit(134)", r"TetGen broke off \(exit code 134\)"),
        ("import no_such_package", "its package tetgen needs no_such_package; run pip install no_such_package"),
        ("return self.points, np.zeros((0, 4), np.int32), np.zeros((0, 1)), None", "found no inside"),
    ],
)
def test_whatever_the_mesher_does_is_one_sentence(stand_in, mode, message):
    stand_in(mode)
    with pytest.raises(MeshError, match=message) as caught:
        tetrahedralize(CUBE, FACES, "tetgen")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("name", "licence"), [("ftetwild", "MPL-2.0"), ("tetgen", "AGPL-3.0")])
def test_missing_packages_are_named_with_their_licence(monkeypatch, name, licence):
    monkeypatch.setattr("difftetvr.mesh.making.surfaces.find_spec", lambda package: None)
    with pytest.raises(MeshError, match=rf"\({licence}\) is not installed; .* pip install 'difftetvr\[mesh\]'"):
        tetrahedralize(CUBE, FACES, name)


@pytest.mark.parametrize(
    ("vertices", "triangles", "message"),
    [
        (CUBE[:, :2], FACES, r"shape \(8, 2\)"),
        (CUBE, FACES[:0], "at least one"),
        (CUBE, FACES + 1, "out of range"),
        (CUBE * [1, 1, np.nan], FACES, "Triangle 0 has a vertex that is not finite"),
        (CUBE * [1, 1, 0], FACES, "one plane"),
        (CUBE, [[0, 1], [2]], "cannot be read as arrays"),
    ],
)
def test_arrays_that_are_no_surface(vertices, triangles, message):
    with pytest.raises(MeshError, match=message):
        as_surface(vertices, triangles)


def test_options_out_of_range(stand_in):
    for options, message in (
        ({"cells": 0}, "number of cells"),
        ({"edge_length": -1.0}, "edge length"),
        ({"cells": 9, "edge_length": 1.0}, "one of them"),
        ({"tolerance": 0.0}, "tolerance"),
    ):
        with pytest.raises(MeshError, match=message):
            MesherOptions(**options)
    stand_in()
    with pytest.raises(MeshError, match="open along 3 edges"):
        tetrahedralize(CUBE, FACES[1:], "tetgen")
    with pytest.raises(MeshError, match="lower < upper"):
        tetrahedralize_box((0, 0, 0), (1, 1, 0), "tetgen")
    with pytest.raises(MeshError, match="no mesher 'gmsh'"):
        tetrahedralize(CUBE, FACES, "gmsh")


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".obj", ".off", ".msh", ".vtk", ".vtu"])
def test_surfaces_of_files(tmp_path, suffix):
    path = tmp_path / f"cube{suffix}"
    meshio.Mesh(CUBE, [("triangle", FACES)]).write(path, "gmsh" if suffix == ".msh" else None)
    points, triangles = load_surface(path)
    assert len(points) == 8 and len(triangles) == 12 and open_edges(triangles) == 0
    assert np.linalg.det(points[triangles]).sum() / 6 == pytest.approx(1.0)


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".obj", ".off", ".msh", ".vtk", ".vtu"])
def test_files_that_are_cut_off_are_refused_or_a_surface_of_less(tmp_path, suffix):
    """Wherever they end: meshio's readers of some formats would wait for the rest forever."""
    path = tmp_path / f"cube{suffix}"
    meshio.Mesh(CUBE, [("triangle", FACES)]).write(path, "gmsh" if suffix == ".msh" else None)
    content = path.read_bytes()
    # Others' readers run in processes of their own, which take their time to begin.
    for end in range(0, len(content), len(content) // 4 if suffix in through_meshio.SURFACES else 7):
        path.write_bytes(content[:end])
        with contextlib.suppress(MeshError):
            load_surface(path)


def test_quadrilaterals_are_cut_and_other_files_refused(tmp_path):
    quads = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]])
    meshio.Mesh(CUBE, [("quad", quads)]).write(tmp_path / "cube.obj")
    points, triangles = load_surface(tmp_path / "cube.obj")
    assert np.linalg.det(points[triangles]).sum() / 6 == pytest.approx(1.0)
    (tmp_path / "broken.ply").write_bytes(os.urandom(100))
    meshio.Mesh(CUBE, [("tetra", [[0, 1, 2, 4]])]).write(tmp_path / "solid.vtk")
    for name, message in (
        ("none.ply", "no surface file"),
        ("broken.ply", "cannot be read"),
        ("solid.vtk", "no triangles"),
    ):
        with pytest.raises(MeshError, match=message):
            load_surface(tmp_path / name)
