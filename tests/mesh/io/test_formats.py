"""Formats other than .vtu: what each can hold is kept to the bit, and what others write in it is read."""

import numpy as np
import pytest
import torch

from difftetvr.errors import MeshError
from difftetvr.mesh import Field, TetMesh
from difftetvr.mesh.io import load, load_data, load_mesh, save

meshio = pytest.importorskip("meshio")

POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], dtype=float)
TETS = np.array([[0, 1, 2, 3], [1, 2, 3, 4]])


def model(location, dtype):
    generator = torch.Generator().manual_seed(5)
    mesh = TetMesh.grid((2, 3, 2), (-1.0, 0.1, 0.0), (1.0, 0.7, 3.0), dtype=dtype)
    mesh = mesh.with_vertices(mesh.vertices + 0.01 * torch.rand(mesh.vertices.shape, generator=generator, dtype=dtype))
    count = mesh.num_vertices if location == "vertex" else mesh.num_cells
    color = torch.rand(count, 3, generator=generator, dtype=dtype) / 3
    density = torch.rand(count, generator=generator, dtype=dtype) * 1e-3
    return mesh, Field(color, density, location=location)


@pytest.mark.parametrize("location", ["vertex", "cell"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("suffix", [".vtu", ".vtk", ".msh", ".xdmf", ".npz", ".bintet", ".ovm", ".node", ".ele"])
def test_round_trips_keep_every_bit(tmp_path, suffix, dtype, location):
    if suffix == ".bintet" and dtype == torch.float64:
        pytest.skip("the format holds float32 only")
    mesh, field = model(location, dtype)
    save(tmp_path / f"a{suffix}", mesh, field)
    mesh_read, field_read = load(tmp_path / f"a{suffix}", dtype)
    assert field_read.location == location
    assert torch.equal(mesh_read.vertices, mesh.vertices)
    assert torch.equal(field_read.color, field.color)
    assert torch.equal(field_read.density, field.density)
    if suffix == ".ovm":  # knows the faces of a cell, not where a list of its vertices began
        assert torch.equal(mesh_read.tets.sort(1).values, mesh.tets.sort(1).values)
        assert (mesh_read.volumes() > 0).all()
    else:
        assert torch.equal(mesh_read.tets, mesh.tets)


@pytest.mark.parametrize("suffix", [".vtu", ".vtk", ".msh", ".mesh", ".xdmf", ".npz", ".bintet", ".ovm", ".node"])
def test_geometry_alone_is_written_and_read(tmp_path, suffix):
    mesh, _ = model("vertex", torch.float32)
    save(tmp_path / f"a{suffix}", mesh)
    data = load_data(tmp_path / f"a{suffix}")
    assert data.field is None
    assert torch.equal(data.mesh.vertices, mesh.vertices)
    assert data.mesh.num_cells == mesh.num_cells


def test_what_formats_cannot_hold(tmp_path):
    mesh, field = model("vertex", torch.float64)
    with pytest.raises(MeshError, match=r"'\.mesh' holds a mesh but neither colour nor density"):
        save(tmp_path / "a.mesh", mesh, field)
    save(tmp_path / "a.bintet", mesh, field)
    rounded, _ = load(tmp_path / "a.bintet", torch.float64)
    assert torch.equal(rounded.vertices, mesh.vertices.float().double())
    thin = TetMesh(
        torch.tensor([[1, 0, 0], [2, 0, 0], [1, 1, 0], [1, 0, 1e-9]], dtype=torch.float64) + 1, [[0, 1, 2, 3]]
    )
    with pytest.raises(MeshError, match="its volume is zero"):
        save(tmp_path / "b.bintet", thin)
    assert [p.name for p in tmp_path.iterdir()] == ["a.bintet"]


def bintet(*arrays, version=1):
    parts = [np.array([version], "<u4").tobytes()]
    for values in arrays:
        parts += [np.array([len(values)], "<u4").tobytes(), values.tobytes()]
    return b"".join(parts)


def test_bintet_of_the_original(tmp_path):
    indices, points = TETS.astype("<u4").ravel(), POINTS.astype("<f4")
    vertex_colors = np.arange(20, dtype="<f4").reshape(5, 4)
    cell_colors = np.arange(8, dtype="<f4").reshape(2, 4)
    path = tmp_path / "a.bintet"
    path.write_bytes(bintet(indices, points, vertex_colors))
    _, field = load(path)
    assert field.location == "vertex" and field.density.tolist() == [3, 7, 11, 15, 19]
    path.write_bytes(bintet(indices, points, vertex_colors[:0], cell_colors, version=2))
    _, field = load(path)
    assert field.location == "cell" and field.color.tolist() == [[0, 1, 2], [4, 5, 6]]
    for content, sentence in (
        (bintet(indices, points, vertex_colors, version=3), "is of version 3"),
        (bintet(indices[:7], points, vertex_colors), "7 cell indices do not make whole"),
        (bintet(indices, points, vertex_colors[:2]), "2 colours for 5 vertices"),
        (bintet(indices, points, vertex_colors) + b"\0", "1 bytes follow its end"),
        (bintet(indices, points, vertex_colors)[:-1], "need at least 80 bytes but only 79 are left"),
        (np.array([1, 2**32 - 4], "<u4").tobytes(), "need at least 17179869168 bytes but only 0"),
    ):
        path.write_bytes(content)
        with pytest.raises(MeshError, match=sentence):
            load(path)


def test_tetgen_with_comments_attributes_and_markers(tmp_path):
    rows = "\n".join(f"{i + 1} {x} {y} {z} {10 * i} {i % 2} # point" for i, (x, y, z) in enumerate(POINTS))
    (tmp_path / "a.node").write_text(f"# made by TetGen\n5 3 1 1\n{rows}\n# end\n")
    (tmp_path / "a.ele").write_text("2  4  1\n  1  1 2 3 4  7\n  2  2 3 4 5  8\n# Generated\n")
    for suffix in (".node", ".ele"):
        data = load_data(tmp_path / f"a{suffix}")
        assert torch.equal(data.mesh.vertices, torch.from_numpy(POINTS).float())
        assert data.point_data["attribute_0"].tolist() == [0, 10, 20, 30, 40]
        assert data.point_data["marker"].tolist() == [0, 1, 0, 1, 0]
        assert data.cell_data["attribute_0"].tolist() == [7, 8]
    (tmp_path / "a.node").unlink()
    with pytest.raises(MeshError, match=r"one of a pair and there is no a\.node"):
        load_mesh(tmp_path / "a.ele")


OVM = """OVM ASCII
# comment
Vertices
4
0 0 0
1 0 0
0 1 0
0 0 1
Edges
6
0 1
1 2
2 0
0 3
1 3
2 3
Faces
4
3 0 2 4
3 0 8 7
3 2 10 9
3 4 6 11
Polyhedra
1
4 0 2 4 6
VProp float "density"
1
2
3
4
VProp Vec3d "color"
0 0 0
0.1 0.1 0.1
0.2 0.2 0.2
0.3 0.3 0.3
EProp int "crease"
1
1
1
1
1
1
MProp string "author"
someone
"""


def test_ovm_with_properties(tmp_path):
    path = tmp_path / "a.ovm"
    path.write_text(OVM)
    mesh, field = load(path)
    assert sorted(mesh.tets[0].tolist()) == [0, 1, 2, 3]
    assert field.density.tolist() == [1, 2, 3, 4]
    path.write_text(OVM.replace("4 0 2 4 6", "4 0 2 4 4"))
    with pytest.raises(MeshError, match="do not make a tetrahedron"):
        load(path)
    path.write_text(OVM.replace("1\n4 0 2 4 6", "1\n6 0 2 4 6 1 3"))
    with pytest.raises(MeshError, match="cells that are no tetrahedra"):
        load(path)
    path.write_bytes(b"OVMB\n\r\n\xff")
    with pytest.raises(MeshError, match="binary form"):
        load(path)


def test_gmsh_with_gaps_in_its_numbers(tmp_path):
    """Nodes in any order with any numbers, data for some elements only: all go where their numbers say."""
    order, numbers = [3, 1, 4, 0, 2], [50, 7, 100, 20, 9]
    nodes = "\n".join(f"{numbers[i]} " + " ".join(map(str, POINTS[i])) for i in order)
    tets = "\n".join(f"{9 - k} 4 2 1 {k} " + " ".join(str(numbers[v]) for v in tet) for k, tet in enumerate(TETS))
    data = "\n".join(f"{numbers[i]} {i}" for i in range(5))
    path = tmp_path / "a.msh"
    text = (
        f"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n5\n{nodes}\n$EndNodes\n$Elements\n3\n1 15 2 0 1 50\n{tets}\n"
        f'$EndElements\n$NodeData\n1\n"p"\n1\n0.0\n3\n0\n1\n5\n{data}\n$EndNodeData\n$ElementData\n1\n"e"\n1\n0.0\n3\n'
        "0\n1\n2\n8 0.5\n9 0.25\n$EndElementData\n"
    )
    path.write_text(text)
    found = load_data(path)
    assert found.point_data["p"].tolist() == [order[i] for i in range(5)]
    assert torch.equal(found.mesh.vertices, torch.from_numpy(POINTS[order]).float())
    assert found.cell_data["e"].tolist() == [0.25, 0.5]
    assert found.cell_data["gmsh:geometrical"].tolist() == [0, 1]
    path.write_text(text.replace("8 0.5", "3 0.5"))
    with pytest.raises(MeshError, match="data belong to an element that is not there"):
        load_data(path)
    path.write_text(text.replace("\n100 0.0", "\n7 0.0"))
    with pytest.raises(MeshError, match="two nodes or elements have one number"):
        load_data(path)


@pytest.mark.parametrize("parametric", [0, 1])
def test_gmsh_4_in_several_blocks(tmp_path, parametric):
    extra = " 0.5 0.5" if parametric else ""
    low = "\n".join(" ".join(map(str, p)) + extra for p in POINTS[:2])
    high = "\n".join(" ".join(map(str, p)) for p in POINTS[2:])
    path = tmp_path / "a.msh"
    path.write_text(
        "$MeshFormat\n4.1 0 8\n$EndMeshFormat\n$Anything\n0 0 1 1\nanything\n$EndAnything\n$Nodes\n2 5 1 30\n"
        f"2 1 {parametric} 2\n1\n2\n{low}\n3 1 0 3\n10\n20\n30\n{high}\n$EndNodes\n"
        "$Elements\n3 3 1 3\n2 1 2 1\n1 1 2 10\n3 1 4 1\n2 1 2 10 20\n3 2 4 1\n3 2 10 20 30\n$EndElements\n"
    )
    data = load_data(path)
    assert torch.equal(data.mesh.vertices, torch.from_numpy(POINTS).float())
    assert data.mesh.num_cells == 2
    assert data.cell_data["gmsh:geometrical"].tolist() == [1, 2]


def test_medit_as_others_write_it(tmp_path):
    path = tmp_path / "a.mesh"
    vertices = "\n".join(f"{x} {y} {z} 3" for x, y, z in POINTS)
    path.write_text(
        f"MeshVersionFormatted 2\n\nDimension\n3\n# comment\nVertices 5\n{vertices}\nTriangles\n1\n1 2 3 0\n"
        "Tetrahedra\n2\n1 2 3 4 6\n2 3 4 5 7\nCorners 1\n1\nEnd\n"
    )
    data = load_data(path)
    assert data.cell_data["medit:ref"].tolist() == [6, 7]
    assert data.point_data["medit:ref"].tolist() == [3] * 5


def test_xdmf_with_binary_files_beside_it_only(tmp_path):
    inside = tmp_path / "inside"
    inside.mkdir()
    header = b"head"
    (inside / "p.bin").write_bytes(header + POINTS.astype(">f8").tobytes())
    (inside / "t.bin").write_bytes(TETS.astype("<i4").tobytes())
    item = '<DataItem DataType="{}" Precision="{}" Dimensions="{}" Format="Binary" Endian="{}" Seek="{}">{}</DataItem>'
    text = (
        '<Xdmf Version="3.0"><Domain><Grid Name="g"><Geometry Type="XYZ">{}</Geometry>'
        '<Topology Type="Tetrahedron">{}</Topology></Grid></Domain></Xdmf>'
    )
    points = item.format("Float", 8, "5 3", "Big", len(header), "p.bin")
    tets = item.format("Int", 4, "2 4", "Little", 0, "t.bin")
    path = inside / "a.xdmf"
    path.write_text(text.format(points, tets))
    assert torch.equal(load_mesh(path, torch.float64).vertices, torch.from_numpy(POINTS))
    path.write_text(text.format(points.replace("5 3", "50000000000 3"), tets))
    with pytest.raises(MeshError, match=r"p\.bin is shorter than announced"):
        load_mesh(path)
    outside, absent = "lies outside of its folder", "which is not there; put it beside it"
    for name, message in (("../p.bin", outside), ("/dev/zero", outside), ("q.bin", absent)):
        path.write_text(text.format(points.replace("p.bin", name), tets))
        with pytest.raises(MeshError, match=message):
            load_mesh(path)
    path.write_text(text.format('<DataItem Dimensions="5 3" Format="HDF">a.h5:/p</DataItem>', tets))
    with pytest.raises(MeshError, match=f"h5py|{absent}"):
        load_mesh(path)
