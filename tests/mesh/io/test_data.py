"""What is read beside geometry and field: other cells, flat cells, data of simulations; real meshes."""

import numpy as np
import pytest
import torch

from difftetvr.errors import MeshError
from difftetvr.mesh.io import load_data, load_mesh

meshio = pytest.importorskip("meshio")

POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], dtype=float)
TETS = np.array([[0, 1, 2, 3], [1, 2, 3, 4]])
FLAT = np.array([[0, 1, 2, 3], [0, 1, 2, 2], [0, 1, 2, 4], [1, 2, 3, 5]])
FLAT_POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, 1, 1]], dtype=float)


def test_quadratic_cells_are_straightened_and_say_so(tmp_path):
    middles = [(POINTS[a] + POINTS[b]) / 2 for a, b in ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))]
    points = np.concatenate([POINTS[:4], middles])
    data = {"p": np.arange(10.0)}
    meshio.Mesh(points, [("tetra10", np.arange(10)[None])], point_data=data).write(tmp_path / "a.vtu")
    with pytest.raises(MeshError, match=r"1 cell of type 'tetra10'.*split=True"):
        load_data(tmp_path / "a.vtu")
    found = load_data(tmp_path / "a.vtu", split=True)
    assert found.mesh.num_vertices == 4
    assert found.point_data["p"].tolist() == [0, 1, 2, 3]
    assert "Straightened 1 cell of type 'tetra10'" in found.warnings[0]


@pytest.mark.parametrize("suffix", [".vtu", ".npz"])
def test_flat_cells_are_refused_or_left_out(tmp_path, suffix):
    values = np.arange(4.0)
    path = tmp_path / f"a{suffix}"
    if suffix == ".npz":
        np.savez(path, vertices=FLAT_POINTS, tets=FLAT, c=values, p=np.arange(6.0))
    else:
        cells = [("tetra", FLAT)]
        meshio.Mesh(FLAT_POINTS, cells, point_data={"p": np.arange(6.0)}, cell_data={"c": [values]}).write(path)
    with pytest.raises(
        MeshError, match=r"Cell 1: its volume is zero, as it repeats a vertex .* 2 of 4 cells; load with"
    ):
        load_mesh(path)
    data = load_data(path, flat="drop")
    assert data.mesh.num_cells == 2
    assert data.flat_cells == 2
    assert data.warnings == ("2 of 4 cells have no volume and were left out; they do not change the picture.",)
    assert data.cell_data["c"].tolist() == [0, 3]
    assert data.point_data["p"].tolist() == [0, 1, 2, 3, 5]
    assert load_mesh(path, flat="drop").num_vertices == 5


def test_nothing_but_flat_cells(tmp_path):
    np.savez(tmp_path / "a.npz", vertices=FLAT_POINTS, tets=FLAT[1:3])
    with pytest.raises(MeshError, match="of its 2 cells none has any volume"):
        load_mesh(tmp_path / "a.npz", flat="drop")


def test_data_of_an_archive(tmp_path):
    arrays = {"pressure": np.arange(5.0), "id": np.array([2**40, 1]), "dims": np.arange(3), "flags": np.ones(5, bool)}
    np.savez(tmp_path / "a.npz", points=POINTS, cells=TETS, time=np.array(3.0), **arrays)
    data = load_data(tmp_path / "a.npz", torch.float64)
    assert set(data.point_data) == {"pressure", "flags"} and set(data.cell_data) == {"id"}
    assert data.cell_data["id"].tolist() == [2**40, 1]
    assert data.point_data["pressure"].dtype == torch.float64
    assert data.point_data["flags"].dtype == torch.int64
    assert data.field is None and data.warnings == ()


def test_arrays_that_are_no_field_are_data(tmp_path):
    np.savez(tmp_path / "a.npz", vertices=POINTS, tets=TETS, color=np.ones((5, 3)), density=np.full(5, -1.0))
    data = load_data(tmp_path / "a.npz")
    assert data.field is None
    assert "density of vertex 0 is -1" in data.warnings[0]
    assert data.point_data["density"].tolist() == [-1] * 5
    with pytest.raises(MeshError, match="density of vertex 0 is -1"):
        load_data(tmp_path / "a.npz", require_field=True)


REAL = {
    "CylinderLinear.vtk": (1522, 465, {"velocity": 3, "vel_norm": 1}, 0),
    "bluntfin.npz": (187318, 40941, {"density": 1, "momentum": 3, "energy": 1}, 77),
    "bunny.mesh": (34055, 5433, {"medit:ref": 1}, 0),
    "hand.msh": (29998, 7234, {}, 0),
    "hexa.vtk": (63888, 12167, {"scalars": 1}, 0),
    "oxygen-post.npz": (513375, 109744, {"density": 1, "momentum": 3, "energy": 1}, 0),
    "post.vtk": (8750, 2288, {"Pressure": 1}, 0),
    "tetraMesh.vtk": (160, 55, {"scalars": 1}, 0),
}


@pytest.mark.parametrize("name", REAL)
def test_real_meshes(shared_data, name):
    cells, vertices, arrays, flat = REAL[name]
    data = load_data(shared_data / "meshes" / name, split=True, flat="drop")
    assert (data.mesh.num_cells, data.mesh.num_vertices, data.flat_cells) == (cells, vertices, flat)
    assert {n: v.shape[1] if v.ndim == 2 else 1 for n, v in data.point_data.items()} == arrays
    assert all(v.isfinite().all() for v in data.point_data.values())
    assert bool(data.warnings) == bool(flat)
