"""Data as they are written: any name, type and shape is read back, or one sentence says what a format cannot hold."""

import tempfile
import unicodedata
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from hypotheses import examples
from hypothesis import example, given
from hypothesis import strategies as st

import difftetvr as dtv
from difftetvr.errors import MeshError, MeshWarning

SUFFIXES = (".vtu", ".vtk", ".msh", ".xdmf", ".npz")
MESH = dtv.TetMesh.grid((2, 2, 1))
V, T = MESH.num_vertices, MESH.num_cells


def is_ordinary(name):
    """Whether every format must hold a name."""
    return '"' not in name and len(name) < 60 and all(unicodedata.category(c) not in ("Cc", "Cn") for c in name)


@pytest.mark.parametrize("suffix", SUFFIXES)
@example("p & q", "T<300")
@example('a"b', "it's > ]]>")
@example("my scalar", "100%25")
@example("Größe", " 温度 \u2028")
@example("two\nlines", "tab\there\r")
@example("\x01", "\ufffe")
@example("\0", "file")
@example("location", "allow_pickle")
@example("vertices", "points")
@example("a" * 300, "ä" * 100)
@examples(60)
@given(on_points=st.text(min_size=1, max_size=20), on_cells=st.text(min_size=1, max_size=20))
def test_names_are_read_back_or_refused(suffix, on_points, on_cells):
    points, cells = np.arange(V) + 0.5, np.arange(T)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a{suffix}"
        try:
            dtv.save(path, MESH, point_data={on_points: points}, cell_data={on_cells: cells})
        except MeshError as error:
            assert suffix == ".npz" or not (is_ordinary(on_points) and is_ordinary(on_cells))
            assert "\n" not in str(error) and str(error).startswith(str(path))
            assert not list(Path(folder).iterdir())
            return
        data = dtv.load_data(path)
    assert data.point_data.keys() - {on_points} == set()
    assert data.cell_data.keys() - {on_cells} <= {"gmsh:geometrical"}
    assert data.point_data[on_points].tolist() == points.tolist()
    assert data.cell_data[on_cells].tolist() == cells.tolist()


@pytest.mark.parametrize(
    ("suffix", "names"),
    [
        (".vtu", ["p & q", "T<300", 'a"b', "Größe", "two\nlines", "file"]),
        (".vtk", ["my scalar", 'a"b', "Größe", "two\nlines", "100%25", "\x01", "file"]),
        (".msh", ["p & q", "my scalar", "Größe", "file"]),
        (".xdmf", ["p & q", "T<300", 'a"b', "Größe", "two\nlines", "file"]),
        (".npz", ["p & q", 'a"b', "Größe", "two\nlines", "file", "allow_pickle", "points", "a/b"]),
    ],
)
def test_names_that_each_format_holds(tmp_path, suffix, names):
    path = tmp_path / f"a{suffix}"
    dtv.save(path, MESH, point_data={name: np.full(V, i) for i, name in enumerate(names)})
    found = dtv.load_data(path).point_data
    assert {name: values[0].item() for name, values in found.items()} == {name: i for i, name in enumerate(names)}


@pytest.mark.parametrize(
    ("suffix", "name", "sentence"),
    [
        (".vtu", "a\x01b", r"has the character '\\x01', which XML does not know"),
        (".xdmf", "a\x01b", r"has the character '\\x01', which XML does not know"),
        (".xdmf", "\ufffe", r"has the character '\\ufffe', which XML"),
        (".vtk", "\0", r"has the character '\\x00'"),
        (".vtk", "ä" * 50, "is too long"),
        (".msh", 'a"b', "has the character '\"'"),
        (".msh", "two\nlines", r"has the character '\\n'"),
        (".msh", "ä" * 200, "is too long"),
        (".npz", "location", "says whether a field is of vertices or of cells"),
        (".npz", "\0", r"has the character '\\x00'"),
        (".npz", "a" * 70_000, "is too long"),
        (".npz", "tets", "all data need names of their own"),
        (".vtu", "", "have the name ''"),
        (".vtu", "\ud800", "have the name"),
        (".vtu", 3, "have the name 3; give all data names that are text"),
    ],
)
def test_names_that_a_format_cannot_hold(tmp_path, suffix, name, sentence):
    with pytest.raises(MeshError, match=sentence):
        dtv.save(tmp_path / f"a{suffix}", MESH, point_data={name: np.zeros(V)})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("dtype", [*"bBhHiIqQefd", ">f4", ">i8", "?"])
def test_types_keep_their_numbers(tmp_path, suffix, dtype):
    kind = np.dtype(dtype)
    values = np.zeros(V, kind)
    if kind.kind in "iu":
        large = min(np.iinfo(kind).max, 2**53 if suffix == ".msh" else 2**63 - 1)
        values[:3] = large, max(np.iinfo(kind).min, -large), 1
    elif kind.kind == "f":
        values[:4] = np.nan, np.inf, -np.inf, 1 / 3
    else:
        values[::2] = True
    path = tmp_path / f"a{suffix}"
    dtv.save(path, MESH, point_data={"x": values, "one column": values[:, None]})
    found = dtv.load_data(path, torch.float64).point_data
    for name in ("x", "one column"):
        assert np.array_equal(found[name].numpy(), values, equal_nan=kind.kind == "f")


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16, torch.bool, torch.uint8, torch.int64])
def test_types_of_tensors(tmp_path, suffix, dtype):
    values = (torch.rand(T, 3) * 3).to(dtype)
    dtv.save(tmp_path / f"a{suffix}", MESH, cell_data={"x": values})
    assert torch.equal(dtv.load_data(tmp_path / f"a{suffix}").cell_data["x"].double(), values.double())


@pytest.mark.parametrize("suffix", [".vtu", ".vtk", ".xdmf", ".npz"])
@pytest.mark.parametrize("shape", [(2,), (4,), (6,), (3, 3), (17,)])
def test_shapes_of_rows(tmp_path, suffix, shape):
    values = np.random.default_rng(1).random((V, *shape))
    dtv.save(tmp_path / f"a{suffix}", MESH, point_data={"x": values})
    found = dtv.load_data(tmp_path / f"a{suffix}", torch.float64).point_data["x"].numpy()
    kept = values if suffix in (".xdmf", ".npz") else values.reshape(V, -1)
    assert np.array_equal(found, kept)


def test_rows_of_other_shapes_are_said(tmp_path):
    values = np.arange(4.0 * V).reshape(V, 2, 2)
    for suffix in (".vtu", ".vtk"):
        with pytest.warns(MeshWarning, match=r"the data 'x' were written as rows of numbers\.$"):
            dtv.save(tmp_path / f"a{suffix}", MESH, point_data={"x": values})
        found = dtv.load_data(tmp_path / f"a{suffix}", torch.float64).point_data["x"]
        assert found.tolist() == values.reshape(V, 4).tolist()


def test_numbers_of_components_that_gmsh_knows(tmp_path):
    tensor = np.random.default_rng(2).random((V, 3, 3))
    tensor += tensor.transpose(0, 2, 1)
    symmetric = tensor[:, (0, 1, 2, 0, 1, 0), (0, 1, 2, 1, 2, 2)]
    plane, color = np.random.default_rng(3).random((V, 2)), np.random.default_rng(4).random((T, 4))
    path = tmp_path / "a.msh"
    with pytest.warns(MeshWarning) as caught:
        dtv.save(path, MESH, point_data={"full": tensor, "half": symmetric, "uv": plane}, cell_data={"rgba": color})
    assert [str(w.message).removeprefix(f"{path}: ") for w in caught] == [
        "the data 'uv' were written with a third component of 0, as Gmsh knows 1, 3 and 9 components.",
        "the data 'half' were written as symmetric tensors of 9 components, as Gmsh knows 1, 3 and 9 components.",
        "the data 'rgba' were written one component at a time, their names ending in :0, :1, ..., as Gmsh knows 1, 3 "
        "and 9 components.",
    ]
    data = dtv.load_data(path, torch.float64)
    for name in ("full", "half"):
        assert np.array_equal(data.point_data[name].numpy(), tensor.reshape(V, 9))
    assert np.array_equal(data.point_data["uv"].numpy(), np.pad(plane, ((0, 0), (0, 1))))
    assert all(np.array_equal(data.cell_data[f"rgba:{i}"].numpy(), color[:, i]) for i in range(4))
    with pytest.raises(MeshError, match="the components of 'rgba' need the name 'rgba:1', too"):
        dtv.save(tmp_path / "b.msh", MESH, cell_data={"rgba:1": color[:, 0], "rgba": color})
    assert not (tmp_path / "b.msh").exists()


def test_whole_numbers_that_gmsh_rounds_are_said(tmp_path):
    large = torch.full((V,), 2**53 + 1)
    with pytest.warns(MeshWarning, match="the data 'id' were rounded, as Gmsh's numbers are exact up to"):
        dtv.save(tmp_path / "a.msh", MESH, point_data={"id": large})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dtv.save(tmp_path / "a.msh", MESH, point_data={"id": large - 1})


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        ([1], r"point_data is \[1\]; pass a dict of arrays by their names"),
        ("x", "point_data is 'x'; pass a dict"),
        (torch.zeros(V), "point_data is a tensor of shape"),
        ({"x": None}, "the data 'x' are object of shape"),
        ({"x": [[1, 2], [3]]}, "the data 'x' are"),
        ({"x": torch.zeros(V).to_sparse()}, "the data 'x' are"),
        ({"x": torch.zeros(V, device="meta")}, "the data 'x' are"),
        ({"x": np.zeros(V, "M8[s]")}, "the data 'x' are datetime64"),
        ({"x": np.zeros((V, 0))}, r"of shape \(18, 0\)"),
        ({"x": np.ma.masked_equal(np.arange(V), 3)}, "some of the data 'x' are masked"),
    ],
)
def test_what_is_no_data(tmp_path, data, sentence):
    with pytest.raises(MeshError, match=sentence):
        dtv.save(tmp_path / "a.vtu", MESH, point_data=data)
    assert not list(tmp_path.iterdir())


def test_archives_tell_vertices_from_cells(tmp_path):
    """Of as many cells as vertices only a field's own arrays are marked as theirs."""
    grid = dtv.TetMesh.grid((2, 1, 1))
    assert grid.num_cells == grid.num_vertices
    field = dtv.Field(torch.rand(12, 3), torch.rand(12), location="cell")
    with pytest.raises(MeshError, match="cannot tell data of cells from those of vertices"):
        dtv.save(tmp_path / "a.npz", grid, field, cell_data={"id": np.arange(12)})
    with pytest.raises(MeshError, match="cannot tell data of cells from those of vertices"):
        dtv.save(tmp_path / "a.npz", grid, field, point_data={"harmonics": np.arange(12)})
    dtv.save(tmp_path / "a.npz", grid, field, point_data={"id": np.arange(12)})
    data = dtv.load_data(tmp_path / "a.npz")
    assert data.field.location == "cell" and "id" in data.point_data


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("name", ["color", "density", "harmonics"])
def test_one_array_of_a_field_is_data(tmp_path, suffix, name):
    values = np.arange(V, dtype=float)
    dtv.save(tmp_path / f"a{suffix}", MESH, point_data={name: values})
    data = dtv.load_data(tmp_path / f"a{suffix}")
    assert data.field is None and data.point_data[name].tolist() == values.tolist()


@pytest.mark.parametrize(
    ("suffix", "module", "reader"),
    [
        (".vtu", "vtkIOXML", "vtkXMLUnstructuredGridReader"),
        (".vtk", "vtkIOLegacy", "vtkUnstructuredGridReader"),
        (".xdmf", "vtkIOXdmf2", "vtkXdmfReader"),
    ],
)
def test_vtk_reads_what_is_written(tmp_path, suffix, module, reader):
    module = pytest.importorskip(f"vtkmodules.{module}")
    to_numpy = pytest.importorskip("vtkmodules.util.numpy_support").vtk_to_numpy
    random = np.random.default_rng(5)
    data = {"p & q": random.random(V), 'a "b" <é>': np.arange(V, dtype="i1"), "sym": random.random((V, 6))}
    data |= {"ten": random.random((V, 3, 3)), "rgba": random.random((V, 4), dtype="f4"), "u2": np.arange(V, dtype="u2")}
    path = tmp_path / f"a{suffix}"
    dtv.save(path, MESH, point_data=data, cell_data={"id": np.arange(T) + 2**40})
    reader = getattr(module, reader)()
    reader.SetFileName(str(path))
    reader.Update()
    grid = reader.GetOutputDataObject(0)
    assert grid.GetNumberOfCells() == T
    assert np.array_equal(to_numpy(grid.GetPoints().GetData()), MESH.vertices.numpy())
    found = [grid.GetPointData().GetArray(i) for i in range(len(data))]
    assert [array.GetName() for array in found] == list(data)
    for array, values in zip(found, data.values()):
        assert np.array_equal(to_numpy(array).reshape(values.shape), values)
    assert np.array_equal(to_numpy(grid.GetCellData().GetArray(0)), np.arange(T) + 2**40)


@pytest.mark.parametrize("suffix", [".vtu", ".vtk", ".msh", ".mesh"])
def test_meshio_reads_what_is_written(tmp_path, suffix):
    meshio = pytest.importorskip("meshio")
    path = tmp_path / f"a{suffix}"
    values = np.random.default_rng(6).random((V, 3))
    data = {} if suffix == ".mesh" else {"x": values}
    groups = {} if suffix == ".mesh" else {"gmsh:physical": np.arange(T) % 3}
    dtv.save(path, MESH, point_data=data, cell_data=groups)
    found = meshio.read(path)
    assert np.array_equal(found.points, MESH.vertices) and np.array_equal(found.cells_dict["tetra"], MESH.tets)
    assert all(np.array_equal(found.point_data[name], data[name]) for name in data)
    assert all(np.array_equal(np.concatenate(found.cell_data[name]), groups[name]) for name in groups)


@pytest.mark.parametrize("channels", [0, 1, 5])
def test_fields_of_other_channels_are_no_colours_but_data(tmp_path: Path, channels: int) -> None:
    mesh = dtv.TetMesh.grid((2, 2, 2))
    field = dtv.Field(torch.rand(27, channels), torch.rand(27))
    for suffix in (".vtu", ".npz", ".bintet"):
        with pytest.raises(MeshError, match=f"the field has {channels} channels, where files hold three colours"):
            dtv.save(tmp_path / f"model{suffix}", mesh, field)
    if channels:
        dtv.save(tmp_path / "data.vtu", mesh, point_data={"features": field.color, "extinction": field.density})
        read = dtv.load_data(tmp_path / "data.vtu").point_data["features"]
        assert torch.equal(torch.as_tensor(read).reshape(27, channels), field.color)
