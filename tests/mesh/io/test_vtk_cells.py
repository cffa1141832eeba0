"""Cells of all kinds that VTK has, in XML and legacy files: which are taken, as what, and which are not to be seen."""

import itertools

import numpy as np
import pytest
from mesh.io.vtk_files import data_array, numbers, piece, vtu

from difftetvr.errors import MeshError
from difftetvr.mesh.io import load_data

CUBE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], float)
POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], float)
TETS = [[0, 1, 2, 3], [1, 2, 3, 4]]
LEGACY = "# vtk DataFile Version 3.0\nx\nASCII\nDATASET UNSTRUCTURED_GRID\n"


def total(data):
    return float(data.mesh.volumes().sum())


# Number of VTK, order, and the kind that cells have once straightened; all fill boxes of volume 1.
OF_VTK = [(10, 1, "tetra"), (11, 1, "hexahedron"), (12, 1, "hexahedron"), (13, 1, "wedge"), (14, 1, "pyramid")]
OF_VTK += [(15, 1, "pentagonal prism"), (16, 1, "hexagonal prism"), (42, 1, "hexahedron")]
OF_VTK += [(24, 1, "tetra"), (25, 1, "hexahedron"), (26, 1, "wedge"), (27, 1, "pyramid"), (29, 1, "hexahedron")]
OF_VTK += [(37, 1, "pyramid")]
OF_VTK += [
    (number, order, kind)
    for first in (71, 78)
    for number, kind in zip(range(first, first + 3), ("tetra", "hexahedron", "wedge"))
    for order in (1, 2, 3)
]


@pytest.mark.parametrize(("number", "order", "kind"), OF_VTK)
def test_cells_that_vtk_makes(tmp_path, number, order, kind):
    vtk = pytest.importorskip("vtk")
    source = vtk.vtkCellTypeSource()
    source.SetCellType(number)
    source.SetCellOrder(order)
    source.SetBlocksDimensions(2, 1, 1)
    source.Update()
    for suffix, writer in ((".vtu", vtk.vtkXMLUnstructuredGridWriter()), (".vtk", vtk.vtkUnstructuredGridWriter())):
        path = tmp_path / f"a{suffix}"
        writer.SetFileName(str(path))
        writer.SetInputData(source.GetOutput())
        assert writer.Write() == 1
        data = load_data(path, split=None, flat="drop")
        assert total(data) == pytest.approx(2) and data.mesh.is_conforming
        is_curved = number in (24, 25, 26, 27, 29, 37) or (number > 70 and order > 1)
        assert is_curved == any(f"of type '{kind}" in note for note in data.warnings)
        name = kind.replace("hedron", "hedra") if kind.endswith("hedron") else kind + "s"
        count = source.GetOutput().GetNumberOfCells()
        assert (kind == "tetra") != any(f"Split {count} {name} into" in note for note in data.warnings)
        if number != 42:
            assert len(load_data(path, split=True, flat="drop").warnings) == len(data.warnings) - (kind != "tetra")


# Kinds that VTK does not make, with nodes besides their corners anywhere.
@pytest.mark.parametrize(
    ("number", "size", "corners", "volume"),
    [(31, 12, CUBE[[0, 1, 3, 4, 5, 7]], 0.5), (32, 18, CUBE[[0, 1, 3, 4, 5, 7]], 0.5), (33, 24, CUBE, 1)]
    + [(number, 14, np.vstack((CUBE[:4], CUBE[4])), 1 / 3) for number in (74, 81)],
)
def test_other_cells_of_higher_order(tmp_path, number, size, corners, volume):
    points = np.vstack((corners, np.full((size - len(corners), 3), 0.4)))
    (tmp_path / "a.vtu").write_text(vtu(piece(points, [list(range(size))], [number])))
    data = load_data(tmp_path / "a.vtu", split=True)
    assert total(data) == pytest.approx(volume)
    assert len(data.warnings) == 1 and "Straightened 1 cell of type" in data.warnings[0]
    (tmp_path / "a.vtu").write_text(vtu(piece(points, [[0, 1, 2]], [number])))
    with pytest.raises(MeshError, match=r"vertices\)"):
        load_data(tmp_path / "a.vtu", split=True)


def test_kinds_are_counted_together(tmp_path):
    points = np.vstack((CUBE, POINTS + 5, np.full((6, 3), 0.5), CUBE + 9))
    quadratic = [8, 9, 10, 11, *range(13, 19)]
    cells, types = [list(range(8)), list(range(19, 27)), quadratic, [0, 1, 2], [9, 10, 11, 12]], [12, 72, 24, 5, 10]
    (tmp_path / "a.vtu").write_text(vtu(piece(points, cells, types)))
    sentence = r"holds 2 cells of type 'hexahedron' and 1 of type 'tetra10'; only linear tetrahedra.*split=True"
    with pytest.raises(MeshError, match=sentence):
        load_data(tmp_path / "a.vtu")
    assert load_data(tmp_path / "a.vtu", split=None).warnings == (
        "Straightened 1 cell of type 'tetra10'; what nodes other than corners hold was left out.",
        "Split 2 hexahedra into 12 tetrahedra.",
    )
    (tmp_path / "b.vtu").write_text(vtu(piece(CUBE, [list(range(8)), list(range(8))], [41, 12])))
    with pytest.raises(MeshError, match="1 cell of type 'VTK cell type 41', which cannot be split"):
        load_data(tmp_path / "b.vtu", split=True)


FACES = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]
PRISM = [[0, 1, 2], [3, 4, 5], [0, 1, 4, 3], [1, 2, 5, 4], [2, 0, 3, 5]]


def stream(cells):
    return [[len(faces), *itertools.chain.from_iterable([len(face), *face] for face in faces)] for faces in cells]


def tables(cells, are_polyhedra):
    """Faces of polyhedra among other cells, as VTK writes them up to 2.2 and from 2.3 on."""
    lists = iter(stream(cells))
    ends, end = [], 0
    for is_polyhedron in are_polyhedra:
        end += len(next(lists)) if is_polyhedron else 0
        ends.append(end if is_polyhedron else -1)
    old = data_array("faces", list(itertools.chain.from_iterable(stream(cells)))) + data_array("faceoffsets", ends)
    faces = [face for cell in cells for face in cell]
    counts = iter(len(cell) for cell in cells)
    order = np.random.default_rng(0).permutation(len(faces))  # the table of faces may be in any order
    new = data_array("face_connectivity", list(itertools.chain.from_iterable(faces[i] for i in order)))
    new += data_array("face_offsets", np.cumsum([len(faces[i]) for i in order]))
    new += data_array("polyhedron_to_faces", np.argsort(order))
    new += data_array("polyhedron_offsets", np.cumsum([next(counts) if is_one else 0 for is_one in are_polyhedra]))
    return old, new


def test_polyhedra_among_other_cells(tmp_path):
    points = np.vstack((CUBE[[0, 1, 3, 4, 5, 7]], POINTS + 5))
    tet = [[i + 6 for i in face] for face in FACES]
    cells, types = [[6, 7, 8, 9], [7, 8, 9, 10], list(range(6))], [42, 10, 42]
    for faces in tables([tet, PRISM], [True, False, True]):
        (tmp_path / "a.vtu").write_text(vtu(piece(points, cells, types, cell_data=[("c", [0, 1, 2])], faces=faces)))
        data = load_data(tmp_path / "a.vtu", split=True)
        assert total(data) == pytest.approx(1 / 6 + 1 / 3 + 1 / 2)
        assert sorted(data.cell_data["c"].tolist()) == [0, 1, 2, 2, 2]
    legacy = [stream([tet])[0], cells[1], stream([PRISM])[0]]
    text = "".join(f"{len(cell)} {numbers(cell)}\n" for cell in legacy)
    (tmp_path / "a.vtk").write_text(
        f"{LEGACY}POINTS {len(points)} double\n{numbers(points)}\n"
        f"CELLS 3 {sum(len(cell) + 1 for cell in legacy)}\n{text}CELL_TYPES 3\n42\n10\n42\n"
    )
    assert total(load_data(tmp_path / "a.vtk", split=True)) == pytest.approx(1)


def test_polyhedra_that_are_tetrahedra_need_no_splitting(tmp_path):
    faces = tables([[[tet[i] for i in face] for face in FACES] for tet in TETS], [True, True])[0]
    (tmp_path / "a.vtu").write_text(vtu(piece(POINTS, TETS, [42, 42], faces=faces)))
    data = load_data(tmp_path / "a.vtu")
    assert data.mesh.num_cells == 2 and data.warnings == ()


@pytest.mark.parametrize(
    "damage", ["faces", "faceoffsets", "face_offsets", "polyhedron_to_faces", "polyhedron_offsets"]
)
def test_damaged_faces_of_polyhedra(tmp_path, damage):
    rng = np.random.default_rng(1)
    for value in (-5, 0, 1, 3, 7, 100, 2**40):
        for faces in tables([FACES, PRISM], [True, True]):
            if f'"{damage}"' not in faces:
                continue
            head, tail = faces.split(f'Name="{damage}"')
            array, rest = tail.split("</DataArray>", 1)
            begin, values = array.split(">")
            words = values.split()
            words[rng.integers(len(words))] = str(value)
            broken = f'{head}Name="{damage}"{begin}>{" ".join(words)}</DataArray>{rest}'
            (tmp_path / "a.vtu").write_text(vtu(piece(CUBE, [[0, 1, 2, 3], list(range(6))], [42, 42], faces=broken)))
            try:
                load_data(tmp_path / "a.vtu", split=True, flat="drop")
            except MeshError as error:
                assert "a.vtu" in str(error) and "\n" not in str(error)


def test_hidden_and_duplicate_cells_are_left_out(tmp_path):
    points = np.vstack([POINTS + 3 * i for i in range(6)])
    cells = [[i + 5 * k for i in TETS[0]] for k in range(6)]
    flags = np.array([0, 1, 8, 32, 2 | 4 | 16, 0], np.uint8)
    points_flags = np.zeros(len(points), np.uint8)
    points_flags[25], points_flags[0] = 2, 1
    point_data, cell_data = [("vtkGhostType", points_flags)], [("vtkGhostType", flags), ("c", np.arange(6))]
    (tmp_path / "a.vtu").write_text(vtu(piece(points, cells, [10] * 6, point_data, cell_data)))
    listed = "".join(f"4 {numbers(cell)}\n" for cell in cells)
    (tmp_path / "a.vtk").write_text(
        f"{LEGACY}POINTS {len(points)} double\n{numbers(points)}\n"
        f"CELLS 6 30\n{listed}CELL_TYPES 6\n10 10 10 10 10 10\nCELL_DATA 6\nFIELD f 2\nc 1 6 int\n0 1 2 3 4 5\n"
        f"vtkGhostType 1 6 unsigned_char\n{numbers(flags)}\nPOINT_DATA 30\nSCALARS vtkGhostType unsigned_char\n"
        f"LOOKUP_TABLE default\n{numbers(points_flags)}\n"
    )
    for name in ("a.vtu", "a.vtk"):
        data = load_data(tmp_path / name)
        assert data.cell_data["c"].tolist() == [0, 4] and set(data.cell_data) == {"c"} and not data.point_data
        assert data.warnings == ("Left out 4 cells marked as hidden or as another piece's (vtkGhostType).",)
    old = [("vtkGhostLevels", np.array([0, 1, 2, 0, 0, 0], np.uint8)), ("c", np.arange(6))]
    (tmp_path / "a.vtu").write_text(vtu(piece(points, cells, [10] * 6, cell_data=old)))
    assert load_data(tmp_path / "a.vtu").cell_data["c"].tolist() == [0, 3, 4, 5]


def test_polyhedra_may_be_hidden(tmp_path):
    faces = tables([[[tet[i] for i in face] for face in FACES] for tet in TETS], [True, True])[1]
    ghosts = [("vtkGhostType", np.array([32, 0], np.uint8))]
    (tmp_path / "a.vtu").write_text(vtu(piece(POINTS, TETS, [42, 42], cell_data=ghosts, faces=faces)))
    assert load_data(tmp_path / "a.vtu").mesh.vertices.tolist() == POINTS[1:].tolist()


def test_meshes_of_hidden_cells_only_say_so(tmp_path):
    ghosts = [("vtkGhostType", np.array([1, 32], np.uint8))]
    for copies in (1, 2):
        (tmp_path / "a.vtu").write_text(vtu(*copies * [piece(POINTS, TETS, [10, 10], cell_data=ghosts)]))
        with pytest.raises(MeshError, match=rf"All {2 * copies} cells of .* are marked as hidden .*; give the whole"):
            load_data(tmp_path / "a.vtu")
