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
    sentence = fails(capsys, "export", flat_mesh, tmp_path / "a.off")
    assert "'.off' is no format that is written; write a mesh (.vtu, " in sentence
    assert "or a grid (.nrrd, .vti, .nii, .npy), or a surface (.ply, " in sentence
    hexahedron = tmp_path / "a.vtk"
    hexahedron.write_text(HEXAHEDRON)
    assert "1 cell of type 'hexahedron'; only linear" in fails(capsys, "export", hexahedron, tmp_path / "b.vtu")
    assert cli.main(["export", str(hexahedron), str(tmp_path / "b.vtu"), "--split"]) == 0
    assert load_data(tmp_path / "b.vtu").mesh.num_cells == 6


@pytest.mark.parametrize("suffix", [".vtu", ".vtk", ".xdmf", ".npz"])
def test_export_keeps_names_and_components(tmp_path, capsys, suffix):
    mesh = TetMesh.grid((2, 2, 1))
    data = {name: torch.rand(18, 2) for name in ("p & q", "T<300", 'a"b', "my scalar", "Größe")}
    save(tmp_path / "a.npz", mesh, point_data=data)
    output = tmp_path / f"b{suffix}"
    assert cli.main(["export", str(tmp_path / "a.npz"), str(output)]) == 0
    printed = capsys.readouterr()
    assert "without" not in printed.out and printed.err == ""
    found = load_data(output).point_data
    assert found.keys() == data.keys() and all(torch.equal(found[name], data[name]) for name in data)


def test_export_to_gmsh_keeps_groups_and_says_what_it_changes(tmp_path, capsys):
    mesh = TetMesh.grid((2, 2, 1))
    groups = {"gmsh:physical": torch.arange(24) % 3 + 5, "gmsh:geometrical": torch.ones(24, dtype=torch.int64)}
    names = {5: "soft tissue", 7: "bone"}
    save(tmp_path / "a.msh", mesh, cell_data=groups, point_data={"p": torch.rand(18)}, group_names=names)
    assert cli.main(["export", str(tmp_path / "a.msh"), str(tmp_path / "b.msh")]) == 0
    assert capsys.readouterr().err == ""
    assert load_data(tmp_path / "b.msh").group_names == names
    found = load_data(tmp_path / "b.msh").cell_data
    assert found.keys() == groups.keys() and all(torch.equal(found[name], groups[name]) for name in groups)
    save(tmp_path / "a.vtu", mesh, point_data={"stress": torch.rand(18, 6)})
    assert cli.main(["export", str(tmp_path / "a.vtu"), str(tmp_path / "b.msh")]) == 0
    printed = capsys.readouterr()
    assert printed.out == f"Wrote {tmp_path / 'b.msh'} (24 cells, stress)\n"
    assert printed.err.count("\n") == 1 and "the data 'stress' were written as symmetric tensors" in printed.err
    save(tmp_path / "a.npz", mesh, point_data={"a\x01b": torch.rand(18)})
    assert "which XML does not know; rename it" in fails(capsys, "export", tmp_path / "a.npz", tmp_path / "c.vtu")
    assert not (tmp_path / "c.vtu").exists()


def test_models_are_read_less_their_flat_cells(flat_mesh, tmp_path, capsys):
    mesh, field = load_model(flat_mesh, "cpu")
    assert mesh.num_cells == 1 and len(field) == 4
    load_model(flat_mesh, "cpu", MeshOptions(), cli.console())
    assert "1 of 2 cells has no volume" in capsys.readouterr().out
    (tmp_path / "a.vtk").write_text(HEXAHEDRON)
    MeshOptions().load(tmp_path / "a.vtk", cli.console())
    assert capsys.readouterr().out == "Split 1 hexahedron into 6 tetrahedra.\n"
