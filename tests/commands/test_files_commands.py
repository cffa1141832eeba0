"""`info` and `export` on meshes of simulations and in all formats."""

import numpy as np
import pytest
import torch
from commands.helpers import fails

import difftetvr.cli as cli
from difftetvr.cli.options import MeshOptions, load_model
from difftetvr.mesh import Field, TetMesh
from difftetvr.mesh.io import load, load_data, save

HEXAHEDRON = """# vtk DataFile Version 3.0
one cell
ASCII
DATASET UNSTRUCTURED_GRID
POINTS 8 float
0 0 0 1 0 0 1 1 0 0 1 0 0 0 1 1 0 1 1 1 1 0 1 1
CELLS 1 9
8 0 1 2 3 4 5 6 7
CELL_TYPES 1
12
POINT_DATA 8
SCALARS [b]heat double
LOOKUP_TABLE default
0 1 2 3 4 5 6 7
"""


@pytest.fixture
def flat_mesh(tmp_path):
    """A mesh of two tetrahedra, of which one is flat, with pressures and a field."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0]], np.float32)
    field = {"color": np.ones((5, 3), np.float32), "density": np.ones(5, np.float32)}
    path = tmp_path / "flat.npz"
    tets = np.array([[0, 1, 2, 3], [0, 1, 2, 4]])
    np.savez(path, vertices=points, tets=tets, pressure=np.arange(5), heat=np.array([np.nan, 2.5]), **field)
    return path


def test_info_names_data_and_flat_cells(flat_mesh, capsys):
    assert cli.main(["info", str(flat_mesh)]) == 0
    output = capsys.readouterr().out
    assert "1 of 2 cells has no volume and was left out; it does not change the picture." in output
    assert "1, left out" in output
    assert [word in output for word in ("pressure", "0 to 3", "heat", "no finite values")] == [True] * 4


def test_info_of_other_cells(tmp_path, capsys):
    path = tmp_path / "a.vtk"
    path.write_text(HEXAHEDRON)
    assert cli.main(["info", str(path), "--split"]) == 0
    assert "Split" not in capsys.readouterr().out
    assert cli.main(["info", str(path)]) == 0
    output = capsys.readouterr().out
    assert output.count("Split 1 hexahedron into 6 tetrahedra.\n") == 1
    assert "[b]heat" in output and "0 to 7" in output and "6" in output


@pytest.mark.parametrize("suffix", [".vtu", ".vtk", ".msh", ".xdmf", ".npz", ".bintet", ".ovm", ".node"])
def test_export_to_every_format(tmp_path, capsys, suffix):
    mesh = TetMesh.grid((2, 1, 1))
    save(tmp_path / "a.vtu", mesh, Field(torch.rand(12, 3), torch.rand(12), location="cell"))
    output = tmp_path / f"b{suffix}"
    assert cli.main(["export", str(tmp_path / "a.vtu"), str(output)]) == 0
    assert capsys.readouterr().out == f"Wrote {output} (12 cells, color and density)\n"
    assert torch.equal(load(output)[1].color, load(tmp_path / "a.vtu")[1].color)


def test_export_says_what_is_left_out(tmp_path, flat_mesh, capsys):
    target = tmp_path / "a.mesh"
    assert "neither colour nor density" in fails(capsys, "export", flat_mesh, target)
    assert not target.exists()
    assert cli.main(["export", str(flat_mesh), str(target), "--geometry"]) == 0
    output = capsys.readouterr().out
    assert "1 of 2 cells has no volume" in output
    assert "(1 cell, geometry only, without color, density, heat, pressure)" in output
    assert "no format that holds" in fails(capsys, "export", flat_mesh, tmp_path / "a.ply")
    hexahedron = tmp_path / "a.vtk"
    hexahedron.write_text(HEXAHEDRON)
    assert "1 cell of type 'hexahedron'; only linear" in fails(capsys, "export", hexahedron, tmp_path / "b.vtu")
    assert cli.main(["export", str(hexahedron), str(tmp_path / "b.vtu"), "--split"]) == 0
    assert load_data(tmp_path / "b.vtu").mesh.num_cells == 6


def test_models_are_read_less_their_flat_cells(flat_mesh, tmp_path, capsys):
    mesh, field = load_model(flat_mesh, "cpu")
    assert mesh.num_cells == 1 and len(field) == 4
    load_model(flat_mesh, "cpu", MeshOptions(), cli.console())
    assert "1 of 2 cells has no volume" in capsys.readouterr().out
    (tmp_path / "a.vtk").write_text(HEXAHEDRON)
    MeshOptions().load(tmp_path / "a.vtk", cli.console())
    assert capsys.readouterr().out == "Split 1 hexahedron into 6 tetrahedra.\n"
