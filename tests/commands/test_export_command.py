"""`export` to grids and surfaces: which data, where, in which colours, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import SimpleITK
import torch
from commands.helpers import fails
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkIOPLY import vtkPLYReader
from vtkmodules.vtkIOXML import vtkXMLImageDataReader

import difftetvr.cli as cli
from difftetvr import voxelise
from difftetvr.capture.volumes.volume import load_raw
from difftetvr.mesh import Field, TetMesh
from difftetvr.mesh.io import save
from difftetvr.sampling import Grid
from difftetvr.srgb import linear_to_srgb

MESH = TetMesh.grid((4, 4, 4), (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
RADIUS = MESH.vertices.norm(dim=1)


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """A ball of density 20 in its middle and 0 at 0.7 from it, with colours of its places."""
    field = Field(MESH.vertices + 0.5, (20.0 * (1 - RADIUS / 0.7)).clamp(min=0.0))
    save(tmp_path / "a.vtu", MESH, field)
    return tmp_path / "a.vtu"


@pytest.fixture
def simulation(tmp_path: Path) -> Path:
    velocity = torch.rand(MESH.num_vertices, 3)
    cells = {"region": torch.arange(MESH.num_cells) % 3}
    points = {"T": 300.0 + RADIUS, "v": velocity}
    save(tmp_path / "s.vtu", MESH, point_data=points, cell_data=cells)
    return tmp_path / "s.vtu"


def export(capsys, *args) -> str:
    """What it prints."""
    capsys.readouterr()
    assert cli.main(["export", *map(str, args)]) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    return printed.out


def values_of(path: Path) -> np.ndarray:
    """(X, Y, Z)."""
    return load_raw(path, None, None).values.transpose(2, 1, 0)


def arrays_of(path: Path) -> dict[str, tuple[int, ...]]:
    """Shapes of the point data of a .vti."""
    reader = vtkXMLImageDataReader()
    reader.SetFileName(str(path))
    reader.Update()
    data = reader.GetOutput().GetPointData()
    return {data.GetArrayName(i): vtk_to_numpy(data.GetArray(i)).shape for i in range(data.GetNumberOfArrays())}


def colors_of(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Places and colours of a .ply."""
    reader = vtkPLYReader()
    reader.SetFileName(str(path))
    reader.Update()
    found = reader.GetOutput()
    return vtk_to_numpy(found.GetPoints().GetData()), vtk_to_numpy(found.GetPointData().GetArray("RGB"))


def test_density_of_a_model(model, tmp_path, capsys):
    out = tmp_path / "g.nrrd"
    assert export(capsys, model, out, "--size", 12) == f"Wrote {out} (12 x 12 x 12 points, density)\n"
    grid = Grid.around(MESH, size=12)
    density = (20.0 * (1 - RADIUS / 0.7)).clamp(min=0.0)
    expected = voxelise(MESH, density, grid.origin, grid.spacing, grid.shape).numpy()
    np.testing.assert_array_equal(values_of(out), expected)
    image = SimpleITK.ReadImage(str(out))
    assert image.GetOrigin() == pytest.approx(grid.origin) and image.GetSpacing() == pytest.approx(grid.spacing)
    assert "(12 x 12 x 12 points, color and density)" in export(capsys, model, tmp_path / "g.vti", "--size", 12)
    assert arrays_of(tmp_path / "g.vti") == {"color": (1728, 3), "density": (1728,)}
    export(capsys, model, tmp_path / "g.npy", "--scalar", "color", "--size", 3)
    assert np.load(tmp_path / "g.npy").shape == (3, 3, 3, 3)


def test_grids_by_spacing_size_and_samples(model, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("difftetvr.sampling.grids.USUAL_SIZE", 6)
    out = tmp_path / "g.npy"
    for options, shape in (
        (["--spacing", 0.25], (4, 4, 4)),
        (["--spacing", 0.25, 0.5, 0.1], (10, 2, 4)),
        (["--size", 3, 4, 5], (5, 4, 3)),
        ([], (6, 6, 6)),
    ):
        assert cli.main(["export", *map(str, [*options, model, out])]) == 0
        assert np.load(out).shape == shape
    export(capsys, model, out, "--spacing", 2, "--samples", 8, "--outside", -1)
    # One voxel of eight times the box.
    inside = voxelise(MESH, torch.ones(MESH.num_vertices), (0, 0, 0), 2.0, (1, 1, 1), samples=8)
    assert float(inside) == pytest.approx(1 / 8)
    assert float(np.load(out)[0, 0, 0]) < 20 / 8 - 7 / 8
    export(capsys, model, out, "--spacing", 2, "--samples", 8, "--outside", "nan")
    assert np.isnan(np.load(out)).all()


def test_data_of_a_simulation(simulation, tmp_path, capsys):
    assert "there are several scalars (T, region, v)" in fails(capsys, "export", simulation, tmp_path / "g.nrrd")
    assert "there is no scalar 'p'" in fails(capsys, "export", simulation, tmp_path / "g.npy", "--scalar", "p")
    sentence = fails(capsys, "export", simulation, tmp_path / "g.npy", "--scalar", "T", "v")
    assert "would hold 2 arrays (T and v), where a '.npy' holds one; choose one, or write a .vti." in sentence
    assert "T, v and region" in export(capsys, simulation, tmp_path / "g.vti", "--size", 4)
    assert arrays_of(tmp_path / "g.vti") == {"T": (64,), "v": (64, 3), "region": (64,)}
    export(capsys, simulation, tmp_path / "g.vti", "--size", 4, "--scalar", "v:x", "T")
    assert arrays_of(tmp_path / "g.vti") == {"v:x": (64,), "T": (64,)}
    export(capsys, simulation, tmp_path / "g.nrrd", "--size", 4, "--scalar", "region")
    assert set(np.unique(values_of(tmp_path / "g.nrrd"))) <= {0.0, 1.0, 2.0}
    # Neighbours of the middle differ by less than float32 tells at 1e9.
    save(simulation, MESH, point_data={"p": 1e9 + RADIUS.double()})
    export(capsys, simulation, tmp_path / "g.nrrd", "--size", 5)
    found = values_of(tmp_path / "g.nrrd") - 1e9
    assert found.dtype == np.float64 and found[2, 2, 2] == pytest.approx(0.0, abs=1e-5)
    assert found[2, 2, 3] == pytest.approx(0.2, abs=1e-5)


def test_cells_without_values_are_outside(tmp_path, capsys):
    scalar = RADIUS.clone()
    scalar[0] = torch.nan
    data = {"T": scalar, "nothing": torch.full_like(scalar, torch.nan)}
    save(tmp_path / "s.vtu", MESH, point_data=data, cell_data={"t": 2**60 + torch.arange(MESH.num_cells)})
    printed = export(capsys, tmp_path / "s.vtu", tmp_path / "g.vti", "--size", 4, "--outside", -9)
    cells = int((MESH.tets == 0).any(1).sum())
    assert printed.splitlines()[:3] == [
        "'nothing' has no finite value and was left out.",
        f"'T' has no finite value in {cells} cells, which were left out.",
        f"'t' is counted from {2**60}, its least value.",
    ]
    assert "(4 x 4 x 4 points, T and t)" in printed
    assert float(load_raw(tmp_path / "g.vti", None, None).values.min()) == -9
    sentence = fails(capsys, "export", tmp_path / "s.vtu", tmp_path / "g.nrrd", "--scalar", "nothing")
    assert "is finite in no cell" in sentence


def volume(path: Path, fields: str, values: np.ndarray) -> Path:
    nz, ny, nx = values.shape
    head = f"NRRD0005\ntype: float\ndimension: 3\nsizes: {nx} {ny} {nz}\nencoding: raw\nendian: little\n{fields}\n\n"
    path.write_bytes(head.encode() + values.astype("<f4").tobytes())
    return path


def test_the_grid_of_a_volume(simulation, tmp_path, capsys):
    fields = "space: RAS\nspace directions: (0,0.2,0) (0.1,0,0) (0,0,-0.3)\nspace origin: (-0.4,-0.3,0.4)\n"
    fields += 'space units: "mm" "mm" "mm"'
    like = volume(tmp_path / "like.nrrd", fields, np.zeros((3, 7, 4)))
    export(capsys, simulation, tmp_path / "g.nrrd", "--scalar", "T", "--like", like)
    one, other = (SimpleITK.ReadImage(str(path)) for path in (like, tmp_path / "g.nrrd"))
    assert one.GetSize() == other.GetSize() == (4, 7, 3)
    for what in ("GetOrigin", "GetSpacing", "GetDirection"):
        np.testing.assert_allclose(getattr(one, what)(), getattr(other, what)(), atol=1e-12)
    header = (tmp_path / "g.nrrd").read_bytes().partition(b"\n\n")[0] + b"\n"
    assert b"\nspace: right-anterior-superior\n" in header and b'\nspace units: "mm" "mm" "mm"\n' in header
    # Along x of the file runs y of the world, along y x, along z z backwards.
    at = voxelise(MESH, 300.0 + RADIUS, (-0.4, -0.3, -0.2), (0.1, 0.2, 0.3), (7, 4, 3)).numpy()
    found = load_raw(tmp_path / "g.nrrd", None, None).values
    np.testing.assert_allclose(found.transpose(2, 1, 0), at, atol=1e-4)


def test_a_grid_elsewhere_is_refused(simulation, tmp_path, capsys):
    far = volume(tmp_path / "far.nrrd", "spacings: 1 1 1\naxis mins: 100 0 0", np.zeros((3, 7, 4)))
    args = ["export", simulation, tmp_path / "g.nrrd", "--scalar", "T"]
    assert "or --fitted if it was fitted to this one." in fails(capsys, *args, "--like", far)
    # One point of it is in the mesh.
    corner = volume(tmp_path / "corner.nrrd", "spacings: 1 1 1", np.zeros((3, 7, 4)))
    assert "does not lie where" in fails(capsys, *args, "--like", corner)
    export(capsys, *args[1:], "--like", corner, "--fitted")
    assert "There is no file" in fails(capsys, *args, "--like", tmp_path / "none.nrrd")
    assert "leave out --spacing and --size" in fails(capsys, *args, "--like", corner, "--size", 5)
    assert "give both" in fails(capsys, *args, "--fitted")


def test_a_model_goes_back_to_the_place_of_what_it_was_fitted_to(tmp_path, capsys):
    """A linear field in the world of the views, whose box is that of the samples: centred, the longest side 1."""
    folder = tmp_path / "run"
    folder.mkdir()
    save(folder / "model.vtu", MESH, Field(torch.zeros(len(RADIUS), 3), 1.0 + MESH.vertices[:, 0]))
    fields = "space dimension: 3\nspace directions: (0,-2,0) (4,0,0) (0,0,8)\nspace origin: (100,200,300)"
    scan = volume(tmp_path / "scan.nrrd", fields, np.zeros((3, 5, 3)))
    # x of the world goes along y of the file, which has 16 of the longest side, also 16.
    expected = np.broadcast_to(np.linspace(0.5, 1.5, 5)[None, :, None], (3, 5, 3)).transpose(2, 1, 0)

    def found(*options: str) -> np.ndarray:
        export(capsys, folder / "model.vtu", tmp_path / "g.nrrd", "--like", scan, *options)
        image = SimpleITK.ReadImage(str(tmp_path / "g.nrrd"))
        assert image.GetOrigin() == (100, 200, 300) and image.GetSpacing() == (2, 4, 8)
        return SimpleITK.GetArrayFromImage(image).transpose(2, 1, 0)

    np.testing.assert_allclose(found("--fitted"), expected, atol=1e-6)
    config = folder / "config.json"
    config.write_text(json.dumps({"capture": str(scan), "capture_options": {}, "fit": {}}))
    np.testing.assert_allclose(found(), expected, atol=1e-6)
    # Of x it is told that it is a quarter as long as the others now.
    options = {"spacing": [1.0, 8.0, 8.0]}
    config.write_text(json.dumps({"capture": str(scan), "capture_options": options, "fit": {}}))
    np.testing.assert_allclose(found(), 1.0 + 0.25 * (expected - 1.0), atol=1e-6)
    for text in (json.dumps({"capture": "another.nrrd", "capture_options": {}, "fit": {}}), "{"):
        config.write_text(text)
        args = ("export", folder / "model.vtu", tmp_path / "g.nrrd", "--like", scan)
        assert "does not lie where" in fails(capsys, *args)


@pytest.mark.parametrize(
    ("capture", "is_encoded"),
    [
        ("photos/transforms.json", True),
        ("scan.nrrd", False),
        ("srgb.npz", True),
        ("linear.npz", False),
        ("no.npz", False),
    ],
)
def test_colours_of_models_of_photographs_are_encoded_already(tmp_path, capsys, capture, is_encoded):
    folder = tmp_path / "run"
    folder.mkdir()
    save(folder / "model.vtu", MESH, Field(torch.full((len(RADIUS), 3), 0.5), 20 * (1 - RADIUS)))
    for encoding in ("srgb", "linear"):
        np.savez(tmp_path / f"{encoding}.npz", encoding=np.array(encoding))
    config = {"capture": str(tmp_path / capture), "capture_options": {}, "fit": {}}
    (folder / "config.json").write_text(json.dumps(config))
    printed = export(capsys, folder / "model.vtu", tmp_path / "s.ply")
    assert ("Its colors are taken as sRGB-encoded" in printed) == is_encoded
    assert set(colors_of(tmp_path / "s.ply")[1].ravel()) == {128 if is_encoded else 188}
    export(capsys, folder / "model.vtu", tmp_path / "s.ply", "--colors", "linear")
    assert set(colors_of(tmp_path / "s.ply")[1].ravel()) == {188}


def test_models_in_the_folder_of_their_run_are_known(run, tmp_path, capsys):
    printed = export(capsys, run / "model.vtu", tmp_path / "g.nrrd", "--like", "tooth")
    assert printed.startswith(f"{run / 'model.vtu'} was fitted to tooth: its box is laid onto that of the samples.\n")
    assert "(103 x 94 x 161 points, density)" in printed
    assert export(capsys, run / "model.vtu", tmp_path / "s.ply").count("sRGB") == 0


def test_surface_of_a_model(model, tmp_path, capsys):
    out = tmp_path / "s.ply"
    # ln 2 / 0.2, where light halves within a fifth of 1.
    lines = export(capsys, model, out).splitlines()
    assert lines[0].startswith("The level of 'density' is 3.46574, which halves light within a fifth of the mesh's")
    assert lines[1].startswith(f"Wrote {out} (") and lines[1].endswith(" triangles, density 3.46574)")
    places, colors = colors_of(out)
    assert np.linalg.norm(places, axis=1).mean() == pytest.approx(0.7 * (1 - 3.46574 / 20), abs=0.02)
    linear = torch.from_numpy(places) + 0.5
    np.testing.assert_allclose(colors, 255 * linear_to_srgb(linear), atol=1)
    export(capsys, model, out, "--level", 10, "--colors", "srgb")
    places, colors = colors_of(out)
    np.testing.assert_allclose(colors, 255 * (places + 0.5), atol=1)
    for suffix in (".glb", ".vtp", ".obj", ".stl"):
        assert "triangles, density 10)" in export(capsys, model, tmp_path / f"s{suffix}", "--level", 10)


def test_surface_of_a_simulation(simulation, tmp_path, capsys):
    out = tmp_path / "s.vtp"
    printed = export(capsys, simulation, out, "--scalar", "T")
    assert printed.startswith("The level of 'T' is 300.433, the middle of its range; --level chooses another.\n")
    assert "magnitude of v" in export(capsys, simulation, out, "--scalar", "v")
    printed = export(capsys, simulation, out, "--scalar", "region", "--level", 1)
    assert "'region' is constant in cells; the means of those around each vertex are taken." in printed
    sentence = fails(capsys, "export", simulation, out, "--scalar", "T", "--level", 5)
    assert "The surface of 'T' at 5 is empty, as its values lie from 300 to 300.866; choose a --level" in sentence
    assert "--level is nan" in fails(capsys, "export", simulation, out, "--scalar", "T", "--level", "nan")
    assert "name one of T, v with --scalar" in fails(capsys, "export", simulation, out, "--scalar", "T", "v")
    save(simulation, MESH, point_data={"one": torch.ones(MESH.num_vertices)})
    assert "'one' is 1 everywhere, so it has no surface" in fails(capsys, "export", simulation, out)


def test_colours_where_cells_have_no_value(model, tmp_path, capsys):
    scalar = RADIUS.clone()
    scalar[0] = torch.nan
    save(model, MESH, Field(MESH.vertices + 0.5, torch.ones(len(RADIUS))), point_data={"T": scalar})
    printed = export(capsys, model, tmp_path / "s.ply", "--scalar", "T", "--level", 0.6, "--colors", "srgb")
    assert "'T' has no finite value in" in printed
    places, colors = colors_of(tmp_path / "s.ply")
    np.testing.assert_allclose(colors, 255 * (places + 0.5), atol=1)


def test_fields_on_cells(tmp_path, capsys):
    middles = MESH.vertices[MESH.tets.long()].mean(1)
    save(tmp_path / "a.vtu", MESH, Field(middles + 0.5, 20 * (1 - middles.norm(dim=1)), location="cell"))
    printed = export(capsys, tmp_path / "a.vtu", tmp_path / "s.ply", "--level", 12)
    assert "'density' is constant in cells" in printed
    places, colors = colors_of(tmp_path / "s.ply")
    assert np.abs(colors / 255 - linear_to_srgb(torch.from_numpy(places) + 0.5).numpy()).mean() < 0.1
    export(capsys, tmp_path / "a.vtu", tmp_path / "g.vti", "--size", 4)
    assert arrays_of(tmp_path / "g.vti") == {"color": (64, 3), "density": (64,)}


@pytest.mark.parametrize(
    ("args", "sentence"),
    [
        (["g.nrrd", "--level", "1"], "--level is for a surface (.ply, .glb, .vtp, .obj, .stl), which "),
        (["g.ply", "--samples", "2"], "--samples is for a grid (.nrrd, .vti, .nii, .npy), which "),
        (["g.vtu", "--outside", "nan"], "--outside is for a grid"),
        (["g.vtu", "--scalar", "T"], "--scalar is for a grid, a surface or a page"),
        (["g.vti", "--geometry"], "--geometry is for a mesh"),
        (["g.stl", "--without-harmonics"], "--without-harmonics is for a mesh"),
        (["nowhere/g.ply"], "create the folder first"),
        (["g.npy", "--spacing", "0"], "spacing is 0.0; pass one or three finite numbers greater than 0"),
        (["g.npy", "--spacing", "1", "2"], "--spacing is '1 2'; give a number or 3 numbers."),
        (["g.npy", "--spacing", "1e-6"], "A spacing of 1e-06 makes a grid of 1e+18 points"),
        (["g.npy", "--size", "1.5"], "--size is '1.5'; give a whole number or 3 whole numbers."),
        (["g.npy", "--samples", "0"], "samples is 0"),
        (["g.npy", "--device", "abacus"], "The device 'abacus' cannot be used"),
        (["g"], "'' is no format that is written"),
    ],
)
def test_mistakes_get_one_sentence(model, tmp_path, capsys, args, sentence):
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    assert sentence in fails(capsys, "export", model, tmp_path / args[0], *args[1:])
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
