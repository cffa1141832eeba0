"""Gmsh's files in all formats: groups, several meshes, data at several times, data of elements' nodes."""

import struct

import numpy as np
import pytest
import torch

from difftetvr.errors import MeshError, MeshWarning
from difftetvr.mesh import TetMesh
from difftetvr.mesh.io import load_data, save
from difftetvr.mesh.io.formats.gmsh import reading

meshio = pytest.importorskip("meshio")

POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], dtype=float)
TETS = np.array([[0, 1, 2, 3], [1, 2, 3, 4]])
TAGS = np.array([10, 20, 30, 40, 70])
"""Of the nodes, as Gmsh leaves gaps."""

HEAD = "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n"


class Writer:
    """Numbers as text or binary."""

    def __init__(self, version, binary, size):
        self.binary, self.version, self.size = binary, version, size
        self.out = b"$MeshFormat\n%s %d %d\n" % (version.encode(), binary, size)
        self.out += struct.pack("<i", 1) + b"\n" if binary else b""
        self.out += b"$EndMeshFormat\n"

    def section(self, name, *parts):
        """Parts are pairs of a letter (i: int, n: count, t: tag, d: double) and numbers."""
        self.out += b"$%s\n" % name.encode()
        letters = {"i": "i4", "d": "f8", "n": f"u{self.size if self.version == '4.1' else 8}"}
        letters["t"] = letters["n"] if self.version == "4.1" else "i4"
        for letter, numbers in parts:
            numbers = np.ravel(numbers)
            if self.binary:
                self.out += numbers.astype("<" + letters[letter]).tobytes()
            else:
                self.out += (" ".join(map(repr, numbers.tolist())) + "\n").encode()
        self.out += b"\n$End%s\n" % name.encode()

    def entities(self, physical):
        """Two volumes, a curve and a point; groups of the volumes by tag."""
        box = ("d", np.zeros(6))
        point = ("d", np.zeros(3)) if self.version == "4.1" else box
        parts = [("n", [1, 1, 0, 2]), ("i", 5), point, ("n", 0), ("i", 6), box, ("n", 1), ("i", 99), ("n", 1), ("i", 5)]
        for tag, groups in physical.items():
            parts += [("i", tag), box, ("n", len(groups)), ("i", groups), ("n", 2), ("i", [1, -2])]
        self.section("Entities", *parts)

    def mesh(self, volumes=(1, 2)):
        """The points, with parameters for those in a surface, and one tetrahedron in each volume."""
        low, high = ("i", [2, 4, 1]), ("i", [3, 1, 0])
        if self.version == "4.1":
            nodes = [
                ("n", [2, 5, 10, 70]),
                low,
                ("n", 2),
                ("t", TAGS[:2]),
                ("d", np.hstack([POINTS[:2], POINTS[:2, 1:]])),
            ]
            nodes += [high, ("n", 3), ("t", TAGS[2:]), ("d", POINTS[2:])]
            blocks = [("i", [3, volumes[0], 4]), ("i", [3, volumes[1], 4])]
        else:
            nodes = [("n", [2, 5]), ("i", [4, 2, 1]), ("n", 2)]
            for tag, point in zip(TAGS[:2], POINTS[:2]):
                nodes += [("i", tag), ("d", [*point, *point[1:]])]
            nodes += [("i", [1, 3, 0]), ("n", 3)]
            for tag, point in zip(TAGS[2:], POINTS[2:]):
                nodes += [("i", tag), ("d", point)]
            blocks = [("i", [volumes[0], 3, 4]), ("i", [volumes[1], 3, 4])]
        self.section("Nodes", *nodes)
        elements = [("n", [2, 2, 3, 8][: 4 if self.version == "4.1" else 2])]
        for block, number, tet in zip(blocks, (8, 3), TETS):
            elements += [block, ("n", 1), ("t", [number, *TAGS[tet]])]
        self.section("Elements", *elements)


def data(kind, name, rows, step=0, time=0.0, columns=1, partition=None):
    tail = "" if partition is None else f"{partition}\n"
    text = "".join(" ".join(map(str, row)) + "\n" for row in rows)
    sizes = f"{3 + bool(tail)}\n{step}\n{columns}\n{len(rows)}\n{tail}"
    return f'${kind}\n1\n"{name}"\n1\n{time}\n{sizes}{text}$End{kind}\n'


def text_mesh(points=POINTS, tag=7):
    nodes = "".join(f"{i + 1} {' '.join(map(str, p))}\n" for i, p in enumerate(points))
    tets = "".join(f"{i + 1} 4 2 {tag} 1 {' '.join(str(n + 1) for n in t)}\n" for i, t in enumerate(TETS))
    return f"$Nodes\n{len(points)}\n{nodes}$EndNodes\n$Elements\n2\n{tets}$EndElements\n"


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize(("version", "size"), [("4", 8), ("4.0", 8), ("4.1", 8), ("4.1", 4)])
def test_physical_groups_are_cell_data(tmp_path, version, size, binary):
    writer = Writer(version, binary, size)
    writer.section("PhysicalNames")
    writer.out = writer.out.replace(
        b"$PhysicalNames\n", b'$PhysicalNames\n3\n3 7 "soft tissue"\n3 8 "bone"\n1 99 "wire"\n'
    )
    writer.entities({1: [7], 2: [-8, 12]})
    writer.section("Unknown", ("i", [1, 2, 3]))
    writer.mesh()
    (tmp_path / "a.msh").write_bytes(writer.out)
    found = load_data(tmp_path / "a.msh", torch.float64)
    assert torch.equal(found.mesh.vertices, torch.from_numpy(POINTS))
    assert found.cell_data["gmsh:physical"].tolist() == [7, 8]
    assert found.cell_data["gmsh:geometrical"].tolist() == [1, 2]
    names, several = found.warnings
    assert "7 is 'soft tissue', 8 is 'bone'." in names and "wire" not in names
    assert "several physical groups" in several and "volume 2" in several


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("version", ["4", "4.1"])
def test_partitioned_meshes_know_their_groups(tmp_path, version, binary):
    writer = Writer(version, binary, 8)
    writer.entities({1: [7], 2: []})
    box, few = np.zeros(6), "n" if version == "4.1" else "i"
    parts = [(few, [2, 1]), ("i", [50, 1]), ("n", [1, 0, 0, 2])]
    parts += [("i", [1, 0, 5]), (few, 1), ("i", 1), ("d", box[:3] if version == "4.1" else box), ("n", 0)]
    for tag, parent, own in ((11, 1, []), (12, 2, [9])):
        parts += [("i", [tag, 3, parent]), (few, 2), ("i", [1, 2]), ("d", box), ("n", len(own)), ("i", own)]
        parts += [("n", 1), ("i", [3])]
    writer.section("PartitionedEntities", *parts)
    writer.mesh(volumes=(11, 12))
    writer.section("GhostElements", ("n", 1), ("n", 8), ("i", 1), ("n", 1), ("i", 2))
    (tmp_path / "a.msh").write_bytes(writer.out)
    assert load_data(tmp_path / "a.msh").cell_data["gmsh:physical"].tolist() == [7, 9]


def test_elements_may_have_different_numbers_of_tags(tmp_path):
    more = "3 4 1 9 2 3 4 5\n4 2 0 1 2 3\n5 4 0 1 2 3 5\n6 15 3 1 2 3 1\n$EndElements"
    text = HEAD + text_mesh().replace("$Elements\n2", "$Elements\n6").replace("$EndElements", more)
    (tmp_path / "a.msh").write_text(text)
    found = load_data(tmp_path / "a.msh", loose=True).cell_data
    assert found["gmsh:physical"].tolist()[:2] == [7, 7] and sorted(found["gmsh:physical"].tolist())[0] == 0
    assert set(found) == {"gmsh:physical", "gmsh:geometrical"} and found["gmsh:geometrical"].tolist()[:2] == [1, 1]
    (tmp_path / "a.msh").write_text(text.replace("4 2 7 1", "4 0").replace("4 1 9", "4 0"))
    assert load_data(tmp_path / "a.msh", loose=True).cell_data == {}


def test_damaged_entities_are_a_sentence(tmp_path):
    writer = Writer("4.1", True, 8)
    writer.section("Entities", ("n", [0, 0, 0, 2**50]))
    (tmp_path / "a.msh").write_bytes(writer.out)
    with pytest.raises(MeshError, match=f"announces {2**50} entities"):
        load_data(tmp_path / "a.msh")


def test_blocks_of_one_are_read_as_one(tmp_path):
    """Gmsh 2.2 writes binary elements one by one; kinds may alternate."""
    triangle = struct.pack("<9i", 2, 1, 2, 5, 1, 1, 1, 2, 3)
    tets = [struct.pack("<3i7i", 4, 1, 2, i, 7, 1, *(t + 1)) for i, t in enumerate(TETS)]
    many = [struct.pack("<3i7i", 4, 1, 2, 10 + i, 8, 1, *(TETS[0] + 1)) for i in range(100)]
    elements = [tets[0], triangle, triangle.replace(b"\5", b"\6"), tets[1], *many]
    nodes = b"".join(struct.pack("<i3d", i + 1, *p) for i, p in enumerate(POINTS))
    path = tmp_path / "a.msh"
    head = (
        b"$MeshFormat\n2.2 1 8\n" + struct.pack("<i", 1) + b"\n$EndMeshFormat\n$Nodes\n5\n" + nodes + b"\n$EndNodes\n"
    )
    path.write_bytes(head + b"$Elements\n104\n" + b"".join(elements) + b"\n$EndElements\n")
    content = reading.read(path)
    found = {block.kind: block for block in content.cells}
    assert found["tetra"].nodes.tolist() == [*TETS.tolist(), *[TETS[0].tolist()] * 100]
    assert found["triangle"].nodes.tolist() == [[0, 1, 2]] * 2
    assert content.cell_data["gmsh:physical"][found["tetra"].rows].tolist() == [7, 7] + [8] * 100
    assert content.cell_data["gmsh:physical"][found["triangle"].rows].tolist() == [1, 1]
    path.write_bytes(head + b"$Elements\n105\n" + b"".join(elements) + b"\n$EndElements\n")
    with pytest.raises(MeshError, match=r"a\.msh"):
        reading.read(path)


def test_time_steps_are_chosen_and_said(tmp_path):
    path = tmp_path / "a.msh"
    rows = [[(i + 1, value) for i in range(5)] for value in (1, 2, 3)]
    text = HEAD + text_mesh() + data("NodeData", "still", rows[0], step=4, time=9)
    for step in (2, 0, 1):  # in any order
        text += data("NodeData", "T", rows[step], step, 0.5 * step)
    text += data("NodeData", "S", rows[0], 0, 0.0) + data("NodeData", "S", rows[1], 1, 0.5)
    path.write_text(text)
    found = load_data(path)
    assert found.point_data["T"].tolist() == [3] * 5 and found.point_data["still"].tolist() == [1] * 5
    assert "S" not in found.point_data
    assert any("the last was read, number 2 at time 1" in w for w in found.warnings)
    assert any("'S' have no values at this time step" in w for w in found.warnings)
    found = load_data(path, step=-2)
    assert (found.point_data["T"].tolist(), found.point_data["S"].tolist()) == ([2] * 5, [2] * 5)
    assert not any("step" in w for w in found.warnings)
    with pytest.raises(MeshError, match=r"no time step 3; its 3 steps"):
        load_data(path, step=3)


def test_parts_of_one_step_are_put_together(tmp_path):
    first, second = [(1, 0.5), (2, 1.5)], [(3, 2.5), (4, 3.5), (5, 4.5)]
    text = data("NodeData", "T", first, partition=1) + data("NodeData", "T", second, partition=2)
    (tmp_path / "a.msh").write_text(HEAD + text_mesh() + text)
    assert load_data(tmp_path / "a.msh").point_data["T"].tolist() == [0.5, 1.5, 2.5, 3.5, 4.5]


def test_a_mesh_that_is_there_twice(tmp_path):
    """As Gmsh appends one view to another; data of one name are kept apart unless they are the same."""
    path = tmp_path / "a.msh"
    rows = [[(i + 1, value) for i in range(5)] for value in (1, 2)]
    one = HEAD + text_mesh()
    path.write_text(one + data("NodeData", "a", rows[0]) + one + data("NodeData", "a", rows[1]) + one)
    found = load_data(path)
    assert found.mesh.num_cells == 2
    assert (found.point_data["a"].tolist(), found.point_data["a (2)"].tolist()) == ([1] * 5, [2] * 5)
    path.write_text(2 * (one + data("NodeData", "a", rows[0])))
    assert set(load_data(path).point_data) == {"a"}
    path.write_text(one + HEAD + text_mesh(POINTS * 2))
    with pytest.raises(MeshError, match="holds 2 meshes that differ"):
        load_data(path)


def test_data_without_their_mesh(tmp_path):
    (tmp_path / "a.msh").write_text(HEAD + data("NodeData", "a", [(1, 1.0)]))
    with pytest.raises(MeshError, match=r"holds data \('a'\) without their mesh.*merge both"):
        load_data(tmp_path / "a.msh")


@pytest.mark.parametrize("binary", [False, True])
def test_values_of_elements_nodes_are_averaged_and_said(tmp_path, binary):
    """Where elements agree they are the nodes' values and nothing is said."""
    path = tmp_path / "a.msh"

    def write(values):
        body = data("ElementNodeData", "q", [(i + 1, 4, *row) for i, row in enumerate(values)])
        content = (HEAD + text_mesh() + body).encode()
        if binary:
            nodes = b"".join(struct.pack("<i3d", i + 1, *p) for i, p in enumerate(POINTS))
            tets = b"".join(struct.pack("<7i", i + 1, 7, 1, *(t + 1)) for i, t in enumerate(TETS))
            rows = b"".join(struct.pack("<2i4d", i + 1, 4, *row) for i, row in enumerate(values))
            content = b"$MeshFormat\n2.2 1 8\n" + struct.pack("<i", 1) + b"\n$EndMeshFormat\n"
            content += b"$Nodes\n5\n" + nodes + b"\n$EndNodes\n"
            content += b"$Elements\n2\n" + struct.pack("<3i", 4, 2, 2) + tets + b"\n$EndElements\n"
            head = body.encode().splitlines()[:9]
            content += b"\n".join(head) + b"\n" + rows + b"\n$EndElementNodeData\n"
        path.write_bytes(content)

    write(np.array([0.1, 1, 2, 3, 4])[TETS])
    found = load_data(path, torch.float64)
    assert found.point_data["q"].tolist() == [0.1, 1, 2, 3, 4] and not found.warnings
    write([[0, 1, 2, 3], [3, 2, 3, 9]])
    found = load_data(path)
    assert found.point_data["q"].tolist() == [0, 2, 2, 3, 9]
    assert found.warnings == ("Averaged 'q' at vertices, as each cell has its own values at its nodes.",)


def test_values_of_elements_nodes_of_several_kinds(tmp_path):
    """Rows of different lengths; vectors keep their components."""
    rows = [(1, 4, *range(12)), (2, 4, *range(12))]
    mesh = text_mesh().replace("$Elements\n2\n", "$Elements\n3\n9 2 2 1 1 1 2 3\n")
    body = data("ElementNodeData", "v", [*rows, (9, 3, *range(9))], columns=3)
    (tmp_path / "a.msh").write_text(HEAD + mesh + body)
    found = load_data(tmp_path / "a.msh")
    assert found.point_data["v"][0].tolist() == [0, 1, 2] and found.point_data["v"][4].tolist() == [9, 10, 11]
    (tmp_path / "a.msh").write_text(HEAD + mesh + body.replace("9 3 0 1", "9 3 0"))
    with pytest.raises(MeshError, match="values of 'v'"):
        load_data(tmp_path / "a.msh")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"$NOD\n", "Gmsh's format 1"),
        (b"(0 grid)\n", "ANSYS Fluent"),
        (b"$MeshFormat\n5.0 0 8\n$EndMeshFormat\n", r"Gmsh's format 5\.0"),
        ((HEAD + text_mesh().replace(" 4 2 7", " 33 2 7")).encode(), "Gmsh's type 33, which is not read"),
    ],
)
def test_what_is_not_read_is_named(tmp_path, content, message):
    (tmp_path / "a.msh").write_bytes(content)
    with pytest.raises(MeshError, match=message):
        load_data(tmp_path / "a.msh")


@pytest.mark.parametrize("form", ["gmsh22", "gmsh"])
@pytest.mark.parametrize("kind", ["tetra10", "hexahedron"])
def test_what_meshio_writes(tmp_path, form, kind):
    rng = np.random.default_rng(3)
    points = rng.random((10, 3))
    cells = np.arange(10)[None, : 10 if kind == "tetra10" else 8]
    if kind == "hexahedron":
        points[:8] = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
    values = rng.random((10, 3))
    mesh = meshio.Mesh(points, [(kind, cells)], point_data={"v": values})
    mesh.write(tmp_path / "a.msh", file_format=form)
    found = load_data(tmp_path / "a.msh", torch.float64, split=True)
    corners = 4 if kind == "tetra10" else 8
    assert found.mesh.vertices.tolist() == points[:corners].tolist()
    assert found.point_data["v"].tolist() == values[:corners].tolist()


def test_names_of_groups_are_kept(tmp_path):
    mesh, groups = TetMesh(POINTS, TETS), {"gmsh:physical": np.array([5, 7])}
    names = {5: "soft tissue", 7: "Größe & <>'", 9: "a" * 127}
    save(tmp_path / "a.msh", mesh, cell_data=groups, group_names=names)
    data = load_data(tmp_path / "a.msh")
    assert data.group_names == names
    assert data.warnings == ("Of the physical groups in gmsh:physical, 5 is 'soft tissue', 7 is \"Größe & <>'\".",)
    with pytest.warns(MeshWarning, match="the names of groups were left out, as a '.vtu' holds none"):
        save(tmp_path / "a.vtu", mesh, cell_data=groups, group_names=names)
    for wrong in ({5: 'a"b'}, {5: "a\nb"}, {0: "a"}, {5: "a" * 128}, {5: 3}, {"a": "b"}, {5: "\ud800"}, ["a"]):
        with pytest.raises(MeshError, match=r"Gmsh cannot read the group|group_names"):
            save(tmp_path / "b.msh", mesh, cell_data=groups, group_names=wrong)
    assert not (tmp_path / "b.msh").exists()


def test_groups_are_read_back(tmp_path):
    """Of each cell its own, also where cells of one entity lie in several groups, as other programs write it."""
    mesh = TetMesh(POINTS, TETS)
    for name, values in (
        ("a", {"gmsh:physical": [5, 7], "gmsh:geometrical": [1, 1]}),
        ("b", {"gmsh:physical": [9, 0]}),
    ):
        save(tmp_path / f"{name}.msh", mesh, cell_data=values)
        found = load_data(tmp_path / f"{name}.msh")
        assert {n: v.tolist() for n, v in found.cell_data.items()} == {"gmsh:geometrical": [2, 1], **values}
    for odd in ([-1, 2], [2**31, 1], [0.5, 1.0], [np.nan, 1.0]):
        save(tmp_path / "b.msh", mesh, cell_data={"gmsh:physical": np.array(odd)})
        found = load_data(tmp_path / "b.msh", torch.float64).cell_data["gmsh:physical"]
        assert np.array_equal(found.numpy(), odd, equal_nan=True)
