"""Exodus files, written here as Cubit, MOOSE and Sierra do: blocks of several kinds, variables, steps, sets."""

import sys

import numpy as np
import pytest
import torch

from difftetvr.errors import MeshError
from difftetvr.mesh.io import load_data
from difftetvr.mesh.io.content import CellBlock
from difftetvr.mesh.io.formats import exodus

netCDF4 = pytest.importorskip("netCDF4")
pytest.importorskip("h5py")
from mesh.io.exodus_files import BLOCKS, POINTS, write  # noqa: E402 - it needs netCDF4


@pytest.mark.parametrize(
    ("form", "old"), [("NETCDF4", False), ("NETCDF3_64BIT_OFFSET", False), ("NETCDF3_CLASSIC", True)]
)
def test_blocks_variables_and_steps(tmp_path, form, old):
    path = tmp_path / "a.exo"
    write(path, form, old=old)
    found = load_data(path, torch.float64, split=True)
    assert found.mesh.num_cells == 8 and found.mesh.num_vertices == 9
    assert found.cell_data["exodus:block"].tolist() == [10] * 6 + [20] * 2
    assert found.point_data["p"].tolist() == [20.0 + i for i in range(9)]
    assert found.point_data["q"].tolist() == [-2.0] * 9
    assert found.cell_data["e"].tolist() == [200] * 6 + [201] * 2
    assert found.cell_data["f"][:6].isnan().all() and found.cell_data["f"][6:].tolist() == [201] * 2
    step, left_out = found.warnings[:2]
    assert "number 2 at time 1.5" in step
    assert left_out == "Left out: 2 sets of nodes, 1 variable of the whole mesh."
    assert exodus.read_here(path, 1).point_data["p"].tolist() == [10.0 + i for i in range(10)]
    with pytest.raises(MeshError, match="no time step 3"):
        exodus.read_here(path, 3)


def test_quadratic_tetrahedra_and_empty_blocks(tmp_path):
    """TETRA10 is straightened, and one of 15 nodes, too; blocks of one kind are one."""
    corners = POINTS[[0, 1, 3, 4]]
    edges = [(corners[a] + corners[b]) / 2 for a, b in ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))]
    points = np.concatenate([corners, edges, corners + 5, np.array(edges) + 5, np.zeros((5, 3))])
    second = [*range(10, 20), *range(20, 25)]
    write(tmp_path / "a.e", blocks=[("TETRA10", [[*range(10)]]), ("TETRA", []), ("tetra15", [second])], points=points)
    found = load_data(tmp_path / "a.e", split=True)
    assert found.mesh.num_cells == 2 and found.cell_data["exodus:block"].tolist() == [10, 30]
    assert sum("Straightened 2 cells of type 'tetra10'" in w for w in found.warnings) == 1


@pytest.mark.parametrize(
    ("name", "size", "kind"),
    [
        ("TET4", 4, "tetra"),
        ("TETRA", 10, "tetra10"),
        ("TETRA", 8, "tetra8"),
        ("HEX", 8, "hexahedron"),
        ("HEX20", 20, "hexahedron20"),
        ("HEX", 27, "hexahedron27"),
        ("WEDGE", 6, "wedge"),
        ("WEDGE15", 15, "wedge15"),
        ("PYRAMID14", 14, "pyramid14"),
        ("SHELL3", 3, "triangle"),
        ("QUAD9", 9, "quad9"),
        ("BEAM", 2, "line"),
        ("NFACED", 0, "polyhedron"),
        ("", 4, "unknown4"),
    ],
)
def test_kinds_by_name_and_size(name, size, kind):
    assert exodus._kind(name, size) == (kind, size)


def test_flat_meshes_and_damage_are_a_sentence(tmp_path):
    path = tmp_path / "a.e"
    write(path, blocks=[("QUAD4", [[0, 1, 2, 3]])], points=POINTS[:, :2])
    with pytest.raises(MeshError, match="no mesh of three dimensions"):
        load_data(path)
    path.write_bytes(b"certainly no mesh")
    with pytest.raises(MeshError, match="does not begin as files of NetCDF do"):
        load_data(path)
    for form in ("NETCDF4", "NETCDF3_CLASSIC", "NETCDF3_64BIT_OFFSET", "NETCDF3_64BIT_DATA"):
        write(path, form)
        assert exodus.read_here(path, None).point_data["p"].max() == 29
        content = path.read_bytes()
        for end in (100, len(content) // 2, len(content) - 8):
            path.write_bytes(content[:end])
            with pytest.raises(MeshError, match=r"a\.e cannot be read as a mesh"):
                exodus.read_here(path, None)


def test_cells_of_nodes_that_are_not_there(tmp_path):
    write(tmp_path / "a.e", blocks=[("TETRA", [[0, 1, 2, 70]])])
    with pytest.raises(MeshError, match="vertex index 70 is out of range"):
        load_data(tmp_path / "a.e")


def test_links_out_of_the_file_are_refused(tmp_path):
    """NetCDF's library would follow them."""
    import h5py

    (tmp_path / "in").mkdir()
    write(tmp_path / "in" / "a.e")
    with h5py.File(tmp_path / "secret.h5", "w") as file:
        file["x"] = np.arange(10.0)
    with h5py.File(tmp_path / "in" / "a.e", "a") as file:
        file["coordq"] = h5py.ExternalLink("../secret.h5", "x")
    with pytest.raises(MeshError, match="takes 'coordq' from another file"):
        load_data(tmp_path / "in" / "a.e")


@pytest.mark.parametrize("package", ["netCDF4", "h5py"])
def test_missing_packages_are_named(tmp_path, monkeypatch, package):
    write(tmp_path / "a.ex2")
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MeshError, match=r"is an Exodus file, .*; install them with pip install 'difftetvr\[exodus\]'"):
        load_data(tmp_path / "a.ex2")


def test_merged_blocks_keep_their_rows(tmp_path):
    write(tmp_path / "a.e", blocks=[("TETRA", [[0, 1, 2, 4]]), ("HEX", BLOCKS[0][1]), ("TET4", [[5, 6, 7, 8]])])
    cells = exodus.read_here(tmp_path / "a.e", None).cells
    assert all(isinstance(block, CellBlock) for block in cells)
    assert {block.kind: block.rows.tolist() for block in cells} == {"tetra": [0, 2], "hexahedron": [1]}
