"""``difftetvr mesh``: from files and boxes to meshes that the other commands read."""

import importlib.util

import meshio
import numpy as np
import pytest
from commands.helpers import fails

import difftetvr.cli as cli
from difftetvr.mesh.io import load_mesh

POINTS = np.random.default_rng(3).random((40, 3))


@pytest.mark.parametrize("suffix", [".vtu", ".vtk", ".msh", ".mesh"])
def test_a_grid_in_every_format(tmp_path, capsys, suffix):
    path = tmp_path / f"grid{suffix}"
    assert (
        cli.main(["mesh", "--box", "0", "0", "0", "1", "1", "2", "--mesher", "grid", "--cells", "768", "-o", str(path)])
        == 0
    )
    assert f"Wrote {path} (768 cells" in capsys.readouterr().out
    mesh = load_mesh(path)
    assert mesh.num_cells == 768
    assert mesh.bounds().tolist() == [[0, 0, 0], [1, 1, 2]]
    assert cli.main(["info", str(path)]) == 0
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".ply", ".xyz", ".txt", ".csv"])
def test_delaunay_of_points(tmp_path, suffix):
    path, output = tmp_path / f"points{suffix}", tmp_path / "mesh.vtu"
    if suffix == ".npy":
        np.save(path, POINTS)
    elif suffix == ".npz":
        np.savez(path, points=POINTS)
    elif suffix == ".ply":
        meshio.Mesh(POINTS, []).write(path)
    else:
        np.savetxt(path, np.column_stack((POINTS, POINTS)), delimiter="," if suffix == ".csv" else " ", header="x y z")
    assert cli.main(["mesh", str(path), "--mesher", "delaunay", "-o", str(output)]) == 0
    assert load_mesh(output).num_vertices == 40


@pytest.mark.parametrize("mesher", ["ftetwild", "tetgen"])
def test_a_surface(tmp_path, mesher):
    pytest.importorskip({"ftetwild": "pytetwild", "tetgen": "tetgen"}[mesher])
    box = meshio.Mesh(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [("triangle", [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])]
    )
    box.write(tmp_path / "corner.stl")
    output = tmp_path / "corner.vtu"
    args = ["mesh", str(tmp_path / "corner.stl"), "-o", str(output), "--mesher", mesher, "--edge-length", "0.5"]
    assert cli.main(args) == 0
    assert float(load_mesh(output).volumes().sum()) == pytest.approx(1 / 6, rel=0.02)


def test_what_cannot_be_meshed_is_one_sentence(tmp_path, capsys):
    output = tmp_path / "mesh.vtu"
    np.save(tmp_path / "flat.npy", POINTS * [1, 1, 0])
    np.save(tmp_path / "plane.npy", POINTS[:, :2])
    np.savez(tmp_path / "other.npz", other=POINTS)
    (tmp_path / "words.txt").write_text("three words here\n")
    (tmp_path / "empty.csv").write_text("# x, y, z\n")
    (tmp_path / "broken.ply").write_text("ply\n")
    before = sorted(tmp_path.iterdir())
    delaunay = ("--mesher", "delaunay", "-o", output)
    box = ("--box", 0, 0, 0, 1, 1, 1)
    assert "either" in fails(capsys, "mesh", "-o", output)
    assert "either" in fails(capsys, "mesh", tmp_path / "flat.npy", *box, "-o", output)
    assert "one plane" in fails(capsys, "mesh", tmp_path / "flat.npy", *delaunay)
    assert "(N, 3)" in fails(capsys, "mesh", tmp_path / "plane.npy", *delaunay)
    assert "'points'" in fails(capsys, "mesh", tmp_path / "other.npz", *delaunay)
    assert "holds no points" in fails(capsys, "mesh", tmp_path / "empty.csv", *delaunay)
    assert "cannot be read as points" in fails(capsys, "mesh", tmp_path / "words.txt", *delaunay)
    assert "cannot be read as a mesh" in fails(capsys, "mesh", tmp_path / "broken.ply", *delaunay)
    assert "no file of points" in fails(capsys, "mesh", tmp_path / "nothing.npy", *delaunay)
    assert "takes no" in fails(capsys, "mesh", tmp_path / "flat.npy", *delaunay, "--cells", 5)
    assert "grid cuts" in fails(capsys, "mesh", tmp_path / "flat.npy", "--mesher", "grid", "-o", output)
    assert "lower < upper" in fails(capsys, "mesh", "--box", 0, 0, 0, 1, 1, "nan", "--mesher", "grid", "-o", output)
    assert "number of cells" in fails(capsys, "mesh", *box, "--mesher", "grid", "--cells", 0, "-o", output)
    assert "no format" in fails(capsys, "mesh", *box, "--mesher", "grid", "-o", tmp_path / "mesh.ply")
    assert "Cannot write" in fails(capsys, "mesh", *box, "--mesher", "grid", "-o", tmp_path / "no" / "mesh.vtu")
    if importlib.util.find_spec("tetgen") is None:
        assert "pip install 'difftetvr[mesh]'" in fails(capsys, "mesh", *box, "--mesher", "tetgen", "-o", output)
    assert sorted(tmp_path.iterdir()) == before


def test_the_help_names_the_licences(capsys):
    assert cli.main(["mesh", "--help"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "MPL-2.0" in text and "AGPL-3.0" in text
