"""VTK's own files, legacy and XML, as VTK writes them."""

import base64
import itertools

import numpy as np
import pytest

from difftetvr.errors import MeshError
from difftetvr.mesh.io import load_data

pytest.importorskip("meshio")


def vtk_grid():
    """A grid of VTK with all kinds of linear volume cells, surfaces, many types of data; its tetrahedra's number."""
    vtk = pytest.importorskip("vtk")
    from vtk.util.numpy_support import numpy_to_vtk

    points = np.array(list(itertools.product(range(2), range(2), range(6)))).astype(float)
    number = {tuple(p): i for i, p in enumerate(points.astype(int).tolist())}
    cube = [[number[x, y, z + k] for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))] for k in (0, 1) for z in range(5)]
    cells = [(vtk.VTK_HEXAHEDRON, cube[0] + cube[5]), (vtk.VTK_TRIANGLE, cube[0][:3])]
    low, high = cube[1], cube[6]
    cells += [(vtk.VTK_WEDGE, [low[i] for i in (0, 1, 2)] + [high[i] for i in (0, 1, 2)])]
    low, high = cube[3], cube[8]
    voxel = [low[i] for i in (0, 1, 3, 2)] + [high[i] for i in (0, 1, 3, 2)]
    cells += [(vtk.VTK_VOXEL, voxel)]
    low, high = cube[4], cube[9]
    cells += [(vtk.VTK_PYRAMID, [*low, high[0]]), (vtk.VTK_TETRA, [low[1], low[2], high[0], high[2]])]
    cells += [(vtk.VTK_TRIANGLE_STRIP, low), (vtk.VTK_POLYGON, high[:3]), (vtk.VTK_POLY_LINE, low[:3])]
    grid = vtk.vtkUnstructuredGrid()
    coordinates = vtk.vtkPoints()
    coordinates.SetData(numpy_to_vtk(points, deep=True))
    grid.SetPoints(coordinates)
    for kind, nodes in cells:
        grid.InsertNextCell(kind, len(nodes), nodes)
    for data, count in ((grid.GetPointData(), len(points)), (grid.GetCellData(), len(cells))):
        for dtype in ("f4", "f8", "i1", "u1", "i2", "i4", "u4", "i8"):
            array = numpy_to_vtk(np.arange(count * 2, dtype=dtype).reshape(count, 2), deep=True)
            array.SetName(f"{dtype} two")
            data.AddArray(array)
        scalars = numpy_to_vtk(np.arange(count, dtype=float), deep=True)
        scalars.SetName("s")
        data.SetScalars(scalars)
        names = vtk.vtkStringArray()
        names.SetName("name")
        for i in range(count):
            names.InsertNextValue("" if i % 3 else f"name {i} of " + "é" * 40 * i)
        data.AddArray(names)
        one = numpy_to_vtk(np.arange(count, dtype=float).reshape(count, 1), deep=True)
        one.SetName("one")
        data.AddArray(one)
    return vtk, grid, 6 + 3 + 6 + 2 + 1


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("version", [42, 51])
def test_legacy_files_that_vtk_writes(tmp_path, version, binary):
    vtk, grid, tets = vtk_grid()
    writer = vtk.vtkUnstructuredGridWriter()
    writer.SetFileName(str(tmp_path / "a.vtk"))
    writer.SetInputData(grid)
    writer.SetFileVersion(version)
    (writer.SetFileTypeToBinary if binary else writer.SetFileTypeToASCII)()
    writer.Write()
    data = load_data(tmp_path / "a.vtk", split=True)
    check_vtk_grid(data, tets)
    assert data.warnings == ("Left out data that are no numbers: name.",)


@pytest.mark.parametrize("mode", ["Ascii", "Binary", "Appended", "Appended in base64"])
@pytest.mark.parametrize("compressor", ["None", "ZLib", "LZMA", "LZ4"])
def test_xml_files_that_vtk_writes(tmp_path, mode, compressor):
    if compressor == "LZ4":
        pytest.importorskip("lz4")
    vtk, grid, tets = vtk_grid()
    for header, order in itertools.product(("UInt32", "UInt64"), ("LittleEndian", "BigEndian")):
        writer = vtk.vtkXMLUnstructuredGridWriter()
        writer.SetFileName(str(tmp_path / "a.vtu"))
        writer.SetInputData(grid)
        getattr(writer, f"SetDataModeTo{mode.split()[0]}")()
        getattr(writer, f"SetCompressorTypeTo{compressor}")()
        getattr(writer, f"SetHeaderTypeTo{header}")()
        getattr(writer, f"SetByteOrderTo{order}")()
        writer.SetEncodeAppendedData(mode.endswith("base64"))
        writer.SetBlockSize(64)
        assert writer.Write() == 1
        data = load_data(tmp_path / "a.vtu", split=True)
        check_vtk_grid(data, tets)
        assert data.warnings == ("Left out data that are no numbers: name.",)


def check_vtk_grid(data, tets):
    assert data.mesh.num_cells == tets
    assert float(data.mesh.volumes().sum()) == pytest.approx(1 + 0.5 + 1 + 1 / 3 + 1 / 6)
    of_cells = data.cell_data["s"].tolist()
    assert [of_cells.count(i) for i in range(9)] == [6, 0, 3, 6, 2, 1, 0, 0, 0]
    assert data.cell_data["one"].tolist() == of_cells
    for dtype in ("f4", "f8", "i1", "u1", "i2", "i4", "u4", "i8"):
        values = data.cell_data[f"{dtype} two"]
        assert values.is_floating_point() == (dtype[0] == "f")
        assert values[:, 0].tolist() == [2 * i for i in of_cells]
    assert data.point_data["s"].tolist() == [i for i in range(24) if data.point_data["u1 two"][:, 0].eq(2 * i).any()]


def test_structured_legacy_files(tmp_path):
    path = tmp_path / "a.vtk"
    head = "# vtk DataFile Version 3.0\ngrid\nASCII\nDATASET {}\nDIMENSIONS 3 2 2\n"
    tail = "POINT_DATA 12\nSCALARS s float\nLOOKUP_TABLE default\n" + " ".join(map(str, range(12)))
    points = " ".join(f"{x} {2 * y} {3 * z}" for z in range(2) for y in range(2) for x in range(3))
    for kind, body in (
        ("STRUCTURED_POINTS", "ORIGIN 0 0 0\nSPACING 1 2 3\n"),
        ("RECTILINEAR_GRID", "X_COORDINATES 3 float\n0 1 2\nY_COORDINATES 2 int\n0 2\nZ_COORDINATES 2 float\n0 3\n"),
        ("STRUCTURED_GRID", f"POINTS 12 float\n{points}\n"),
    ):
        path.write_text(head.format(kind) + body + tail)
        data = load_data(path, split=True)
        assert data.mesh.num_cells == 12
        assert float(data.mesh.volumes().sum()) == pytest.approx(12)
        assert data.point_data["s"].tolist() == list(range(12))
    path.write_text(head.format("STRUCTURED_POINTS").replace("3 2 2", "100 100 100") + tail)
    with pytest.raises(MeshError, match="announces 100 x 100 x 100 points"):
        load_data(path, split=True)


@pytest.mark.parametrize("binary", [False, True])
def test_metadata_of_legacy_files(tmp_path, binary):
    """Unnamed components have empty lines, and some programs leave one before what follows the names."""
    vtk = pytest.importorskip("vtk")
    from vtk.util.numpy_support import numpy_to_vtk

    grid, points = vtk.vtkUnstructuredGrid(), vtk.vtkPoints()
    positions = numpy_to_vtk(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]), deep=True)
    positions.SetComponentName(2, "height")
    points.SetData(positions)
    grid.SetPoints(points)
    grid.InsertNextCell(vtk.VTK_TETRA, 4, [0, 1, 2, 3])
    expected = {"v": np.arange(12.0).reshape(4, 3), "tc": np.eye(4, 2), "f": np.ones((4, 5)), "s": np.arange(4.0)}
    add = grid.GetPointData()
    for name, values in expected.items():
        array = numpy_to_vtk(values, deep=True)
        array.SetName(name)
        array.SetComponentName(min(1, array.GetNumberOfComponents() - 1), "named")
        array.GetRange(-1)
        {"v": add.SetVectors, "tc": add.SetTCoords}.get(name, add.AddArray)(array)
    writer = vtk.vtkUnstructuredGridWriter()
    writer.SetInputData(grid)
    writer.SetFileName(str(tmp_path / "a.vtk"))
    (writer.SetFileTypeToBinary if binary else writer.SetFileTypeToASCII)()
    writer.Write()
    content = (tmp_path / "a.vtk").read_bytes()
    assert content.count(b"COMPONENT_NAMES\n\n") == 4 and content.count(b"INFORMATION") > 3
    for text in (content, content.replace(b"\nINFORMATION", b"\n\nINFORMATION")):
        (tmp_path / "a.vtk").write_bytes(text)
        found = load_data(tmp_path / "a.vtk").point_data
        assert {name: values.tolist() for name, values in found.items()} == {n: v.tolist() for n, v in expected.items()}


def test_identifiers_and_arrays_that_do_not_say_how_they_are_stored(tmp_path):
    points, cells = np.vstack((np.zeros(3), np.eye(3))), np.arange(4)
    for dtype in (np.int64, np.int32):
        arrays = ""
        for name, kind, values in (
            ("connectivity", "vtkIdType", cells),
            ("offsets", "vtkIdType", np.array([4])),
            ("types", "vtkIdType", np.array([10])),
        ):
            data = values.astype("<" + np.dtype(dtype).str[1:]).tobytes()
            text = base64.b64encode(np.uint32(len(data)).tobytes() + data).decode()
            arrays += f'<DataArray type="{kind}" Name="{name}" format="binary">{text}</DataArray>'
        text = " ".join(map(str, points.ravel()))
        (tmp_path / "a.vtu").write_text(
            '<VTKFile type="UnstructuredGrid"><UnstructuredGrid><Piece NumberOfPoints="4" NumberOfCells="1">'
            f'<Points><DataArray type="Float64" NumberOfComponents="3">{text}</DataArray></Points>'
            f"<Cells>{arrays}</Cells></Piece></UnstructuredGrid></VTKFile>"
        )
        assert load_data(tmp_path / "a.vtu").mesh.tets.tolist() == [[0, 1, 2, 3]]
