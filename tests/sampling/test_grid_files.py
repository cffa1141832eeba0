"""Files of grids: what other readers, and the project's own, find in them is what `voxelise` gives."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import pytest
import SimpleITK
import torch
from sampling.meshes import bent_mesh
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonDataModel import vtkImageData
from vtkmodules.vtkIOXML import vtkXMLImageDataReader

from difftetvr import save_grid, voxelise, voxelise_to_file
from difftetvr.capture import Volume
from difftetvr.capture.volumes.placement import Placement
from difftetvr.capture.volumes.volume import load_raw
from difftetvr.errors import MeshError
from difftetvr.mesh import TetMesh
from difftetvr.sampling import Grid
from difftetvr.sampling import slabs as slabs_module

GRID = Grid((0.11, -0.02, 0.07), (0.1, 0.11, 0.07), (7, 9, 11))
TURNED = Grid(
    (0.4, 0.3, 0.6),
    (0.071, 0.083, 0.059),
    (7, 6, 5),
    ((0.36, 0.48, -0.8), (-0.8, 0.6, 0.0), (0.48, 0.64, 0.6)),
    "left-posterior-superior",
    "mm",
)
TYPES = [torch.float32, torch.float64]


def read_vti(path: Path) -> vtkImageData:
    reader = vtkXMLImageDataReader()
    reader.SetFileName(str(path))
    reader.Update()
    return reader.GetOutput()


def read_array(image: vtkImageData, name: str) -> np.ndarray:
    """(X, Y, Z[, C])."""
    array = image.GetPointData().GetArray(name)
    shape = (*image.GetDimensions()[::-1], *([array.GetNumberOfComponents()] * (array.GetNumberOfComponents() > 1)))
    values = vtk_to_numpy(array).reshape(shape)
    return values.transpose(2, 1, 0, *range(3, values.ndim))


def sampled(mesh: TetMesh, values: torch.Tensor, grid: Grid = GRID, **options: Any) -> np.ndarray:
    turned, straight = grid.seen_by(mesh)
    return voxelise(turned, values, straight.origin, straight.spacing, straight.shape, **options).numpy()


@pytest.fixture(params=TYPES)
def mesh(request: pytest.FixtureRequest) -> TetMesh:
    return bent_mesh(dtype=request.param)


@pytest.mark.parametrize("options", [{}, {"outside": -3.5}, {"samples": 2, "outside": 1.0}])
def test_nrrd_and_npy_hold_what_voxelise_gives(tmp_path: Path, mesh: TetMesh, options: dict[str, Any]) -> None:
    values = torch.rand(mesh.num_vertices, dtype=torch.float64)
    expected = sampled(mesh, values, **options)
    for name in ("v.nrrd", "v.npy"):
        voxelise_to_file(tmp_path / name, mesh, values, GRID, **options)
        raw = load_raw(tmp_path / name, None, None)
        assert raw.values.dtype == expected.dtype
        np.testing.assert_array_equal(raw.values.transpose(2, 1, 0), expected)
    np.testing.assert_array_equal(np.load(tmp_path / "v.npy").transpose(2, 1, 0), expected)
    header = (tmp_path / "v.nrrd").read_bytes().partition(b"\n\n")[0].decode("ascii")
    assert f"have the value {options.get('outside', 0.0)!r}." in header
    assert ("Means of 2^3 points" in header) == ("samples" in options)
    volume = Volume.load(tmp_path / "v.nrrd", value_range=(-4.0, 2.0))
    assert volume.resolution == GRID.shape and volume.spacing == pytest.approx(GRID.spacing)


def test_itk_finds_values_and_places_of_nrrd(tmp_path: Path, mesh: TetMesh) -> None:
    values = torch.rand(mesh.num_vertices, dtype=torch.float64)
    for grid in (GRID, TURNED):
        voxelise_to_file(tmp_path / "v.nrrd", mesh, values, grid)
        image = SimpleITK.ReadImage(str(tmp_path / "v.nrrd"))
        found = SimpleITK.GetArrayFromImage(image).transpose(2, 1, 0)
        np.testing.assert_array_equal(found, sampled(mesh, values, grid))
        for index in ((0, 0, 0), (6, 0, 0), (0, 5, 0), (6, 5, 4)):
            steps = np.array(grid.directions or np.eye(3)) * np.array(grid.spacing)[:, None]
            place = np.array(grid.origin) + np.array(index) @ steps
            np.testing.assert_allclose(image.TransformIndexToPhysicalPoint(index), place, atol=1e-12)


def test_vectors_in_nrrd(tmp_path: Path, mesh: TetMesh) -> None:
    values = torch.rand(mesh.num_cells, 3)
    voxelise_to_file(tmp_path / "v.nrrd", mesh, values, TURNED, location="cell")
    image = SimpleITK.ReadImage(str(tmp_path / "v.nrrd"))
    found = SimpleITK.GetArrayFromImage(image)
    assert found.shape == (5, 6, 7, 3)
    np.testing.assert_array_equal(found.transpose(2, 1, 0, 3), sampled(mesh, values, TURNED, location="cell"))
    assert image.GetOrigin() == pytest.approx(TURNED.origin)


def test_vtk_finds_arrays_and_places(tmp_path: Path, mesh: TetMesh) -> None:
    arrays = {
        "velocity": torch.rand(mesh.num_vertices, 3),
        "p & <q>": torch.rand(mesh.num_vertices),
        "one": torch.rand(mesh.num_vertices, 1),
        "Größe": torch.rand(mesh.num_cells),
    }
    assert mesh.num_cells != mesh.num_vertices
    for grid in (GRID, TURNED):
        voxelise_to_file(tmp_path / "v.vti", mesh, arrays, grid, samples=2, outside=float("nan"))
        image = read_vti(tmp_path / "v.vti")
        for name, values in arrays.items():
            expected = sampled(mesh, values.reshape(len(values), -1).squeeze(1), grid, samples=2, outside=float("nan"))
            np.testing.assert_array_equal(read_array(image, name), expected)
        assert image.GetPointData().GetScalars().GetName() == "p & <q>"
        assert image.GetDimensions() == grid.shape
        steps = np.array(grid.directions or np.eye(3)) * np.array(grid.spacing)[:, None]
        place = np.array(grid.origin) + np.array((6, 5, 4)) @ steps
        np.testing.assert_allclose(image.GetPoint(image.ComputePointId((6, 5, 4))), place, atol=1e-12)
        raw = load_raw(tmp_path / "v.vti", None, None) if grid is GRID else None
        if raw is not None:
            np.testing.assert_array_equal(raw.values.transpose(2, 1, 0), read_array(image, "p & <q>"))


@pytest.mark.parametrize("name", ["v.nrrd", "v.vti"])
def test_places_come_back(tmp_path: Path, mesh: TetMesh, name: str) -> None:
    voxelise_to_file(tmp_path / name, mesh, torch.rand(mesh.num_vertices), TURNED)
    found = Placement.of(tmp_path / name)
    assert (found.shape, found.spacing) == (TURNED.shape, pytest.approx(TURNED.spacing))
    np.testing.assert_allclose(found.directions, TURNED.directions)
    assert found.world.origin == pytest.approx(TURNED.origin)
    if name == "v.nrrd":
        assert (found.world.space, found.world.unit) == ("left-posterior-superior", "mm")


@pytest.mark.parametrize("name", ["v.nrrd", "v.vti", "v.npy"])
def test_values_that_are_there_already(tmp_path: Path, mesh: TetMesh, name: str) -> None:
    values = torch.rand(mesh.num_vertices, 2, requires_grad=True)
    voxelise_to_file(tmp_path / name, mesh, values, GRID)
    table = voxelise(mesh, values, GRID.origin, GRID.spacing, GRID.shape)
    remark = slabs_module.Sampling().remark()
    save_grid(tmp_path / f"again{name}", table, GRID, remark)
    assert (tmp_path / f"again{name}").read_bytes() == (tmp_path / name).read_bytes()


@pytest.mark.parametrize("name", ["v.nrrd", "v.vti", "v.npy"])
def test_only_some_layers_are_there_at_a_time(
    tmp_path: Path, mesh: TetMesh, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = torch.rand(mesh.num_vertices, 2)
    expected = sampled(mesh, values, samples=2)
    shapes = []

    def spied(*arguments: Any, **options: Any) -> torch.Tensor:
        shapes.append(arguments[4])
        return voxelise(*arguments, **options)

    monkeypatch.setattr("difftetvr.sampling.grid_files.AT_ONCE", 1300)
    monkeypatch.setattr("difftetvr.sampling.slabs.voxelise", spied)
    voxelise_to_file(tmp_path / name, mesh, values, GRID, samples=2)
    # 7 x 9 points of 8 samples: two layers of 1008.
    assert shapes == [(7, 9, 2)] * 5 + [(7, 9, 1)]
    if name == "v.vti":
        found = read_array(read_vti(tmp_path / name), "values")
    else:
        path = str(tmp_path / name)
        image = np.load(path) if name == "v.npy" else SimpleITK.GetArrayFromImage(SimpleITK.ReadImage(path))
        found = image.transpose(2, 1, 0, 3)
    np.testing.assert_allclose(found, expected, atol=1e-12 if expected.dtype == np.float64 else 1e-5)


def test_what_fails_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    resource = pytest.importorskip("resource")
    mesh = bent_mesh()
    values = torch.rand(mesh.num_vertices)
    for name in ("v.nrrd", "v.vti", "v.npy"):
        (tmp_path / name).write_text("old")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (600, hard))
    try:
        for name in ("v.nrrd", "v.vti", "v.npy"):
            with pytest.raises(MeshError, match="file too large"):
                voxelise_to_file(tmp_path / name, mesh, values, GRID)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    # 693 numbers of 8 bytes.
    usage = dataclasses.make_dataclass("usage", ["free"])
    monkeypatch.setattr("shutil.disk_usage", lambda _: usage(5543))
    for name in ("v.vti", "v.npy"):
        with pytest.raises(MeshError, match=r"there is no room for its .* GiB; free some space") as error:
            voxelise_to_file(tmp_path / name, mesh, values, GRID)
        assert "\n" not in str(error.value)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == dict.fromkeys(
        ("v.nrrd", "v.vti", "v.npy"), "old"
    )
    monkeypatch.setattr("shutil.disk_usage", lambda _: usage(5544))
    voxelise_to_file(tmp_path / "v.npy", mesh, values, GRID)


def test_too_little_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = bent_mesh()
    monkeypatch.setattr("difftetvr.trust.free_memory", lambda: 2**27)
    with pytest.raises(MeshError, match=r"layer of the grid of 4000 x 4000 x 2 points would take .* choose a coarser"):
        voxelise_to_file(
            tmp_path / "v.nrrd", mesh, torch.rand(mesh.num_vertices), Grid((0, 0, 0), (1.0,) * 3, (4000, 4000, 2))
        )
    voxelise_to_file(tmp_path / "v.nrrd", mesh, torch.rand(mesh.num_vertices), GRID)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"path": "v.mha"}, r"no file of values on a grid; use one of .nrrd, .vti, .nii, .npy"),
        ({"path": "nowhere/v.npy"}, "create the folder first"),
        (
            {"values": {"a": torch.rand(60), "b": torch.rand(60)}},
            r"hold 2 arrays \(a and b\), where a '.nrrd' holds one",
        ),
        ({"values": {}}, "There are no values"),
        ({"values": {"": torch.rand(60)}}, "have the name ''"),
        ({"values": {"a\x01": torch.rand(60)}, "path": "v.vti"}, "which XML does not know; rename it"),
        ({"values": torch.rand(60, 0)}, "have no components"),
        ({"values": torch.rand(7)}, "There are 7 values"),
        ({"grid": "small"}, "grid is 'small'"),
        ({"samples": 17}, "samples is 17; pass a number from 1 to 16"),
        ({"samples": 1.5}, "samples is 1.5"),
        ({"outside": "none"}, "outside is 'none'"),
    ],
)
def test_mistakes_get_one_sentence(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {"path": "v.nrrd", "values": torch.rand(60), "grid": GRID, **change}
    mesh = bent_mesh()
    assert mesh.num_vertices == 60
    with pytest.raises(MeshError, match=message) as error:
        voxelise_to_file(tmp_path / arguments.pop("path"), mesh, **arguments)
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (torch.rand(7, 9, 10), r"'values' have shape \(7, 9, 10\) on a grid of \(7, 9, 11\) points"),
        (torch.rand(7, 9, 11, 0), "pass a number or a vector for each"),
        (torch.rand(7, 9, 11, 2, 2), "pass a number or a vector for each"),
        ({"a": "text"}, "The values 'a' is 'text'"),
    ],
)
def test_mistakes_about_values_that_are_there(tmp_path: Path, values: Any, message: str) -> None:
    with pytest.raises(MeshError, match=message) as error:
        save_grid(tmp_path / "v.vti", values, GRID)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("grid", [GRID, TURNED])
def test_nifti_files_have_the_places_and_the_vectors_of_the_grid(tmp_path: Path, mesh: TetMesh, grid: Grid) -> None:
    vectors = mesh.vertices.new_tensor(np.random.default_rng(0).random((mesh.num_vertices, 3)))
    for name, values in (("scalars", vectors[:, 0]), ("vectors", vectors)):
        voxelise_to_file(tmp_path / f"{name}.nii", mesh, values, grid)
        image = nibabel.load(tmp_path / f"{name}.nii")
        found = np.asarray(image.dataobj)
        expected = sampled(mesh, values, grid)
        np.testing.assert_array_equal(found if name == "scalars" else found[:, :, :, 0], expected)
        assert found.dtype == expected.dtype and image.header["intent_code"] == (0 if name == "scalars" else 1007)
        signs = np.array([-1, -1, 1]) if grid.space else np.ones(3)
        axes = np.eye(3) if grid.directions is None else np.array(grid.directions)
        index = np.array([2, 3, 1])
        place = signs * (np.array(grid.origin) + (index * np.array(grid.spacing)) @ axes)
        np.testing.assert_allclose(nibabel.affines.apply_affine(image.affine, index), place, atol=1e-6)
        assert image.header.get_xyzt_units()[0] == (grid.unit or "unknown")
    # And our own reader puts them where they were.
    placement = Placement.of(tmp_path / "scalars.nii")
    assert placement.shape == grid.shape and placement.world.unit == grid.unit


def test_arrays_may_have_x_first(tmp_path: Path) -> None:
    mesh = bent_mesh()
    values = mesh.vertices.clone()
    for name, table in (("scalars", values[:, 0]), ("vectors", values)):
        arrays = {name: slabs_module.MeshValues(mesh, table)}
        slabs_module.write_sampled(tmp_path / "v.npy", arrays, GRID, slabs_module.Sampling(), x_first=True)
        found = np.load(tmp_path / "v.npy")
        expected = sampled(mesh, table)
        np.testing.assert_array_equal(found, expected if name == "scalars" else np.moveaxis(expected, -1, 0))
