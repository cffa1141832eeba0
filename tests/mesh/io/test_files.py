"""Mesh files: what is written is read back, what cannot be read says so."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from difftetvr.errors import MeshError
from difftetvr.mesh import Field, TetMesh
from difftetvr.mesh.io import load, load_mesh, load_with_optional_field, save
from difftetvr.mesh.io.formats.table import FORMATS

meshio = pytest.importorskip("meshio")

TET = np.array([[0, 1, 2, 3]])
POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=np.float32)


def random_model(location="vertex"):
    generator = torch.Generator().manual_seed(3)
    mesh = TetMesh.grid((2, 3, 2), (-1.0, 0.1, 0.0), (1.0, 0.7, 3.0))
    mesh = mesh.with_vertices(mesh.vertices + 0.01 * torch.rand(mesh.vertices.shape, generator=generator))
    count = mesh.num_vertices if location == "vertex" else mesh.num_cells
    color = torch.rand(count, 3, generator=generator)
    density = torch.rand(count, generator=generator) * 1e-3
    density[0] = 0.0
    return mesh, Field(color, density, location=location)


def write_points(path, cells=None, point_data=None, cell_data=None, points=POINTS, **options):
    cells = [("tetra", TET)] if cells is None else cells
    meshio.Mesh(points, cells, point_data=point_data, cell_data=cell_data).write(path, **options)


def field_data(count=4):
    return {"color": np.full((count, 3), 0.5, dtype=np.float32), "density": np.ones(count, dtype=np.float32)}


@pytest.mark.parametrize("location", ["vertex", "cell"])
@pytest.mark.parametrize("suffix", [".vtu", ".vtk", ".msh", ".npz"])
def test_round_trip_keeps_every_bit(tmp_path, suffix, location):
    mesh, field = random_model(location)
    save(tmp_path / f"model{suffix}", mesh, field)
    mesh_read, field_read = load(tmp_path / f"model{suffix}")
    assert field_read.location == location
    assert torch.equal(mesh_read.tets, mesh.tets)
    for before, after in (
        (mesh.vertices, mesh_read.vertices),
        (field.color, field_read.color),
        (field.density, field_read.density),
    ):
        assert after.dtype == torch.float32
        assert torch.equal(before.view(torch.int32), after.view(torch.int32))
    assert [p.name for p in tmp_path.iterdir()] == [f"model{suffix}"]


def test_float64_round_trip(tmp_path):
    mesh, field = random_model()
    mesh = mesh.with_vertices(mesh.vertices.double() * (1 + 1e-12))
    field = Field(field.color.double() / 3, field.density.double() / 3)
    save(tmp_path / "model.vtu", mesh, field)
    mesh_read, field_read = load(tmp_path / "model.vtu", dtype=torch.float64)
    assert torch.equal(mesh_read.vertices, mesh.vertices)
    assert torch.equal(field_read.color, field.color)


def test_vtk_reads_our_vtu(tmp_path):
    vtk = pytest.importorskip("vtk")
    from vtk.util.numpy_support import vtk_to_numpy

    mesh, field = random_model()
    save(tmp_path / "model.vtu", mesh, field)
    reader = vtk.vtkXMLUnstructuredGridReader()
    reader.SetFileName(str(tmp_path / "model.vtu"))
    reader.Update()
    grid = reader.GetOutput()
    assert grid.GetNumberOfCells() == mesh.num_cells
    assert grid.GetCellType(0) == vtk.VTK_TETRA
    assert np.array_equal(vtk_to_numpy(grid.GetPoints().GetData()), mesh.vertices.numpy())
    assert np.array_equal(vtk_to_numpy(grid.GetPointData().GetArray("color")), field.color.numpy())
    assert np.array_equal(vtk_to_numpy(grid.GetPointData().GetArray("density")), field.density.numpy())


def test_inverted_cells_are_turned_and_unused_vertices_dropped_with_their_attributes(tmp_path):
    points = np.concatenate([[[9.0, 9.0, 9.0]], POINTS])
    data = {"color": np.arange(15, dtype=np.float32).reshape(5, 3) / 15, "density": np.arange(5, dtype=np.float32)}
    write_points(tmp_path / "a.vtu", [("tetra", np.array([[1, 2, 4, 3]]))], data, points=points)
    mesh, field = load(tmp_path / "a.vtu")
    assert mesh.num_vertices == 4
    assert torch.equal(mesh.vertices, torch.from_numpy(POINTS))
    assert (mesh.volumes() > 0).all()
    assert field.density.tolist() == [1, 2, 3, 4]


def test_surface_cells_beside_the_tetrahedra_are_left_out(tmp_path):
    cells = [("triangle", np.array([[0, 1, 2]])), ("tetra", TET), ("tetra", np.array([[1, 2, 3, 4]]))]
    points = np.concatenate([POINTS, [[1.0, 1.0, 1.0]]])
    cell_data = {
        "color": [np.zeros((1, 3)), np.full((1, 3), 0.25), np.full((1, 3), 0.75)],
        "density": [np.array([9.0]), np.array([1.0]), np.array([2.0])],
    }
    write_points(tmp_path / "a.vtu", cells, cell_data=cell_data, points=points)
    mesh, field = load(tmp_path / "a.vtu")
    assert mesh.num_cells == 2
    assert field.location == "cell"
    assert field.density.tolist() == [1.0, 2.0]


@pytest.mark.parametrize("suffix", [".vtk", ".msh", ".mesh", ".vtu"])
def test_geometry_alone(tmp_path, suffix):
    options = {"file_format": "medit"} if suffix == ".mesh" else {}
    options = {"file_format": "gmsh"} if suffix == ".msh" else options
    write_points(tmp_path / f"a{suffix}", **options)
    assert load_mesh(tmp_path / f"a{suffix}").num_cells == 1
    mesh, field = load_with_optional_field(tmp_path / f"a{suffix}")
    assert field is None
    assert mesh.num_vertices == 4
    with pytest.raises(MeshError, match=r"no color and density.*add both arrays"):
        load(tmp_path / f"a{suffix}")


def test_missing_arrays_are_answered_with_those_found(tmp_path):
    write_points(tmp_path / "a.vtu", point_data={"pressure": np.zeros(4), "color": np.zeros((4, 3))})
    with pytest.raises(MeshError, match="found: point data color, point data pressure"):
        load(tmp_path / "a.vtu")


def test_other_volume_cells_are_refused(tmp_path):
    cube = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=float)
    write_points(tmp_path / "a.vtu", [("hexahedron", np.array([[0, 1, 3, 2, 4, 5, 7, 6]]))], points=cube)
    with pytest.raises(MeshError, match=r"1 cell of type 'hexahedron'.*split=True"):
        load(tmp_path / "a.vtu")


def test_surface_without_tetrahedra_is_refused(tmp_path):
    write_points(tmp_path / "a.vtu", [("triangle", np.array([[0, 1, 2]]))])
    with pytest.raises(MeshError, match=r"no tetrahedra \(found: triangle\)"):
        load(tmp_path / "a.vtu")


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"density": np.array([1, -1, 1, 1], dtype=np.float32)}, "density"),
        ({"density": np.array([1, np.nan, 1, 1], dtype=np.float32)}, "density"),
        ({"color": np.ones((4, 4), dtype=np.float32)}, r"'color' is float32 of shape \(4, 4\)"),
    ],
)
def test_invalid_data_names_file_and_array(tmp_path, change, sentence):
    write_points(tmp_path / "a.vtu", point_data=field_data() | change)
    with pytest.raises(MeshError, match=sentence) as caught:
        load(tmp_path / "a.vtu")
    assert "a.vtu" in str(caught.value)


def test_integers_are_taken_as_they_are(tmp_path):
    color = np.arange(12, dtype=np.uint8).reshape(4, 3)
    write_points(tmp_path / "a.vtu", point_data={"color": color, "density": np.array([0, 7, 2**24 + 1, 3], np.int32)})
    _, field = load(tmp_path / "a.vtu", dtype=torch.float64)
    assert field.color.tolist() == color.tolist()
    assert field.density.tolist() == [0, 7, 2**24 + 1, 3]
    assert load(tmp_path / "a.vtu")[1].color.dtype == torch.float32


def test_negative_integers_and_truth_values_are_refused(tmp_path):
    write_points(tmp_path / "a.vtu", point_data=field_data() | {"density": np.array([1, -1, 1, 1], np.int64)})
    with pytest.raises(MeshError, match="density of vertex 1 is -1"):
        load(tmp_path / "a.vtu")
    data = field_data() | {"density": np.ones(4, dtype=bool)}
    np.savez(tmp_path / "a.npz", vertices=POINTS, tets=TET, **data)
    with pytest.raises(MeshError, match="'density' is bool"):
        load(tmp_path / "a.npz")


def test_index_out_of_range_names_the_file(tmp_path):
    np.savez(tmp_path / "a.npz", vertices=POINTS, tets=np.array([[0, 1, 2, 7]]), **field_data())
    with pytest.raises(MeshError, match=r"a\.npz.*Cell 0"):
        load(tmp_path / "a.npz")


@pytest.mark.parametrize("name", ["a.vtu", "a.vtk", "a.msh", "a.mesh", "a.xdmf", "a.npz", "a.nonsense", "noextension"])
@pytest.mark.parametrize("content", [b"", b"certainly no mesh\n1 2 3\n", bytes(range(256)) * 4])
def test_broken_files_are_one_sentence(tmp_path, capfd, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(MeshError) as caught:
        load(tmp_path / name)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("suffix", [".vtu", ".vtk", ".msh", ".npz"])
@pytest.mark.parametrize("kept", [0.1, 0.5, 0.9])
def test_truncated_files_are_one_sentence(tmp_path, suffix, kept):
    save(tmp_path / f"a{suffix}", *random_model())
    content = (tmp_path / f"a{suffix}").read_bytes()
    (tmp_path / f"b{suffix}").write_bytes(content[: int(kept * len(content))])
    with pytest.raises(MeshError, match=f"b\\{suffix}"):
        load(tmp_path / f"b{suffix}")


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(MeshError, match="no mesh file"):
        load(tmp_path / "nothing.vtu")
    with pytest.raises(MeshError, match="is a folder"):
        load(tmp_path)


def test_save_refuses_what_it_cannot_write(tmp_path):
    mesh, field = random_model()
    with pytest.raises(MeshError, match=r"'\.ply' is no format that holds tetrahedra"):
        save(tmp_path / "a.ply", mesh, field)
    with pytest.raises(MeshError, match="Cannot write"):
        save(tmp_path / "missing" / "a.vtu", mesh, field)
    with pytest.raises(MeshError):
        save(tmp_path / "a.vtu", mesh, Field(field.color[:-1], field.density[:-1]))
    assert not list(tmp_path.iterdir())


def test_failed_save_leaves_the_old_file(tmp_path, monkeypatch):
    mesh, field = random_model()
    save(tmp_path / "a.vtu", mesh, field)
    before = (tmp_path / "a.vtu").read_bytes()

    def full_disk(path, _):
        with open(path, "wb") as file:
            file.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setitem(FORMATS, ".vtu", replace(FORMATS[".vtu"], write=full_disk))
    with pytest.raises(MeshError, match="no space left on device"):
        save(tmp_path / "a.vtu", mesh, field)
    assert (tmp_path / "a.vtu").read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.vtu"]


CLOSES_ARCHIVES = pytest.mark.skipif(
    np.lib.NumpyVersion(np.__version__) < "2.2.0", reason="older numpy also complains of the archive it leaves open"
)

FULL_DISK = """
import resource, sys
from pathlib import Path
from difftetvr.errors import MeshError
from difftetvr.mesh.io import load, save
source, limit, *targets = sys.argv[1:]
mesh, field = load(source)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(limit), resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
for target in targets:
    try:
        save(target, mesh, field)
    except MeshError as error:
        print(error)
"""


@pytest.mark.skipif(os.name != "posix", reason="limits on the size of files are those of POSIX")
@pytest.mark.parametrize("suffixes", [(".vtu", ".vtk", ".msh"), pytest.param((".npz",), marks=CLOSES_ARCHIVES)])
def test_files_that_stop_growing_tell_why(tmp_path, suffixes):
    """A limit on the size of files stands for a full disk: numpy, which counts what it wrote, knows neither."""
    mesh = TetMesh.grid((12, 12, 12))
    save(tmp_path / "a.npz", mesh, Field(torch.rand(mesh.num_vertices, 3), torch.rand(mesh.num_vertices)))
    targets = [tmp_path / f"b{suffix}" for suffix in suffixes]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3] / "src")}
    command = [sys.executable, "-c", FULL_DISK, str(tmp_path / "a.npz"), "20000", *map(str, targets)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    advice = "file too large; raise the limit on the size of files or choose another disk."
    assert done.stdout.splitlines() == [f"Cannot write {target}: {advice}" for target in targets]
    assert done.stderr == ""
    assert [p.name for p in tmp_path.iterdir()] == ["a.npz"]
