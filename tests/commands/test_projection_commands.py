"""``difftetvr project`` and ``voxelise``: what they write, and what they say of bad input."""

import json

import nibabel
import numpy as np
import pytest
import torch
from commands.helpers import fails

import difftetvr as dtv
from difftetvr import cli
from difftetvr.capture import Noise, ProjectionCapture, ProjectionGeometry, load_volume, project_volume

GEOMETRY = {
    "type": "cone",
    "views": 6,
    "source_distance": 5,
    "detector_distance": 7,
    "detector": [12, 10],
    "detector_size": [4, 3.5],
    "volume_size": [2, 1.6, 1.2],
}
VALUES = np.random.default_rng(0).random((6, 8, 10)).astype(np.float32)  # z, y, x


@pytest.fixture
def scan(tmp_path, monkeypatch):
    """A folder with a volume and a geometry."""
    monkeypatch.chdir(tmp_path)
    np.save("volume.npy", VALUES)
    (tmp_path / "g.json").write_text(json.dumps(GEOMETRY))
    return tmp_path


@pytest.fixture
def model(scan):
    """A mesh whose density is 8 + x + 2 y + 4 z in the box from -1 to 1, with a scalar beside it."""
    mesh = dtv.TetMesh.grid((3, 3, 3), (-1, -1, -1), (1, 1, 1))
    density = 8 + mesh.vertices @ torch.tensor([1.0, 2, 4])
    dtv.save("model.vtu", mesh, dtv.Field(torch.rand(mesh.num_vertices, 3), density), point_data={"t": 2 * density})
    return scan / "model.vtu"


def linear(*places: np.ndarray) -> np.ndarray:
    x, y, z = np.meshgrid(*places, indexing="ij")
    return 8 + x + 2 * y + 4 * z


PROJECT = ["project", "volume.npy", "--geometry", "g.json", "--device", "cpu"]


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
def test_projections_of_a_volume(scan, capsys, suffix):
    assert cli.main([*PROJECT, "-o", f"scan{suffix}", "--holdout-every", "3"]) == 0
    said = capsys.readouterr().out
    assert "(6 views of 12 x 10 pixels, line integrals up to " in said and "stretched" not in said
    capture = ProjectionCapture.load(scan / f"scan{suffix}")
    geometry = ProjectionGeometry.from_dict(GEOMETRY)
    expected = project_volume(torch.from_numpy(VALUES.transpose(2, 1, 0).copy()), geometry, device="cpu")
    torch.testing.assert_close(capture.line_integrals, expected)
    assert capture.variance is None and capture.valid is None and capture.test_indices.tolist() == [1, 4]
    assert capture.geometry.to_dict() == geometry.to_dict()


def test_noise_is_seeded_and_said(scan, capsys):
    noise = ["--noise", "poisson:1e4,gaussian:10", "--seed", "7", "--method", "trilinear"]
    assert cli.main([*PROJECT, "-o", "scan.npz", *noise]) == 0
    assert "noise of 0.0" in capsys.readouterr().out
    capture = ProjectionCapture.load("scan.npz")
    clean = project_volume(load_volume("volume.npy").values, capture.geometry, "trilinear", device="cpu")
    expected = Noise(1e4, 10).apply(clean, 7)
    torch.testing.assert_close(capture.line_integrals, expected.line_integrals)
    torch.testing.assert_close(capture.variance, expected.variance)


def test_pixels_without_a_count_are_marked_and_counted(scan, capsys):
    assert cli.main([*PROJECT, "-o", "scan.npz", "--noise", "poisson:2,scale:0.5"]) == 0
    assert "pixels without a count)" in capsys.readouterr().out
    assert not bool(ProjectionCapture.load("scan.npz").valid.all())


def test_integers_are_scaled_and_stretched_voxels_are_said(scan, capsys):
    np.save("volume.npy", (1000 * VALUES).astype(np.uint16))
    (scan / "g.json").write_text(json.dumps(GEOMETRY | {"volume_size": 2}))
    assert cli.main([*PROJECT, "-o", "scan.npz"]) == 0
    said = capsys.readouterr().out
    assert "stand for 0 to 1; --value-range says otherwise" in said
    assert "whose box is 10 x 8 x 6 by their file, are stretched to 2 x 2 x 2" in said
    assert cli.main([*PROJECT, "-o", "other.npz", "--value-range", "0", "1000"]) == 0
    one, other = (ProjectionCapture.load(name).line_integrals for name in ("scan.npz", "other.npz"))
    assert float((one - other).abs().max()) < 0.01


def test_a_volume_of_nothing_is_said(scan, capsys):
    np.save("volume.npy", np.zeros((3, 3, 3), np.float32))
    assert cli.main([*PROJECT, "-o", "scan.npz"]) == 0
    assert "all line integrals are 0" in capsys.readouterr().out
    assert "Nothing absorbs in any view" in fails(capsys, *PROJECT, "-o", "scan.npz", "--noise", "poisson:1e4")


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["-o", "scan.nii"], "no file of projections that is written; use one of .npz, .h5"),
        (["-o", "nowhere/scan.npz"], "create the folder first"),
        (["-o", "scan.npz", "--noise", "strong"], "give it as 'poisson:1e4,gaussian:10'"),
        (["-o", "scan.npz", "--noise", "poisson:1e4", "--seed", "-1"], "The seed is -1"),
        (["-o", "scan.npz", "--method", "joseph"], "give one of siddon, trilinear"),
        (["-o", "scan.npz", "--holdout-every", "1"], "cannot be held out of 6"),
        (["-o", "scan.npz", "--geometry", "none.json"], "There is no file 'none.json'"),
        (["-o", "scan.npz", "--geometry", "volume.npy"], "is no JSON"),
        (["-o", "scan.npz", "--value-range", "3", "1"], "the smaller first"),
        (["-o", "scan.npz", "--device", "tpu"], "tpu"),
    ],
)
def test_bad_projections_are_one_sentence(scan, capsys, words, sentence):
    assert sentence in fails(capsys, *PROJECT, *words)
    assert not list(scan.glob("scan*"))


@pytest.mark.parametrize("values", [np.full((3, 3, 3), np.nan), np.zeros((3, 3), np.float32)])
def test_bad_volumes_are_one_sentence(scan, capsys, values):
    np.save("volume.npy", values)
    assert "volume.npy" in fails(capsys, *PROJECT, "-o", "scan.npz")


def test_voxels_fill_the_box_of_a_mesh(model):
    assert cli.main(["voxelise", "model.vtu", "--shape", "4", "5", "8", "-o", "v.npy", "--device", "cpu"]) == 0
    places = [-1 + (np.arange(n) + 0.5) * 2 / n for n in (4, 5, 8)]
    np.testing.assert_allclose(np.load("v.npy"), linear(*places), atol=1e-5)
    box = ["--bounds", "0", "-1", "-1", "1", "1", "3"]
    assert cli.main(["voxelise", "model.vtu", "--shape", "4", "5", "8", "-o", "b.npy", *box, "--outside", "-1"]) == 0
    places = [(np.arange(4) + 0.5) / 4, places[1], -1 + (np.arange(8) + 0.5) / 2]
    expected = np.where(places[2] < 1, linear(*places), -1)
    np.testing.assert_allclose(np.load("b.npy"), expected, atol=1e-5)


def test_all_formats_hold_the_same_voxels(model):
    for suffix in (".npy", ".nii", ".nrrd"):
        words = ["--shape", "4", "5", "8", "-o", f"v{suffix}", "--scalar", "t", "--device", "cpu"]
        assert cli.main(["voxelise", "model.vtu", *words]) == 0
    values = np.load("v.npy")
    image = nibabel.load("v.nii")
    np.testing.assert_array_equal(image.get_fdata(), values)
    np.testing.assert_allclose(image.affine @ [0, 0, 0, 1], [-0.75, -0.8, -0.875, 1])
    np.testing.assert_array_equal(load_volume("v.nrrd").values, values)
    np.testing.assert_array_equal(load_volume("v.nii").values, values)
    assert values.min() > 2


def write_nrrd(path, values, directions, origin, space="left-posterior-superior"):
    """Values (z, y, x) along directions of the file's axes."""
    steps = " ".join(f"({','.join(map(str, step))})" for step in directions)
    sizes = " ".join(map(str, values.shape[::-1]))
    head = ["NRRD0004", "type: float", "dimension: 3", f"space: {space}", f"sizes: {sizes}"]
    head += [f"space directions: {steps}", "endian: little", "encoding: raw", f"space origin: ({origin})", "", ""]
    path.write_bytes("\n".join(head).encode() + values.astype("<f4").tobytes())


def test_like_lies_where_the_file_says_in_the_order_of_the_world(model, capsys):
    """Axes of the file: the first runs along -y, the second along +x. Values come as `load_volume` has them."""
    values = np.zeros((4, 5, 8), np.float32)
    write_nrrd(model.parent / "scan.nrrd", values, [(0, -0.2, 0), (0.3, 0, 0), (0, 0, 0.25)], "-0.6,0.7,-0.375")
    assert cli.main(["voxelise", "model.vtu", "--like", "scan.nrrd", "-o", "v.npy", "--device", "cpu"]) == 0
    places = [-0.6 + 0.3 * np.arange(5), 0.7 - 0.2 * np.arange(7, -1, -1), -0.375 + 0.25 * np.arange(4)]
    found = np.load("v.npy")
    np.testing.assert_allclose(found, linear(*places), atol=1e-5)
    assert found.shape == tuple(load_volume("scan.nrrd").values.shape)
    # In a file with a place, NIfTI's world has x and y reversed against this one's.
    assert cli.main(["voxelise", "model.vtu", "--like", "scan.nrrd", "-o", "v.nii", "--device", "cpu"]) == 0
    image = nibabel.load("v.nii")
    np.testing.assert_array_equal(image.get_fdata(), found)
    np.testing.assert_allclose(image.affine @ [1, 2, 3, 1], [0.3, 0.3, 0.375, 1], atol=1e-6)


def test_a_model_of_projections_has_the_voxels_of_these(model, capsys):
    """Where project laid the voxels of the volume, voxelise finds them again, though the file tells another place."""
    run = model.parent / "out"
    run.mkdir()
    (run / "model.vtu").write_bytes(model.read_bytes())
    assert cli.main([*PROJECT, "-o", "scan.npz"]) == 0
    (run / "config.json").write_text(json.dumps({"capture": str(model.parent / "scan.npz")}))
    write_nrrd(model.parent / "scan.nrrd", VALUES, np.eye(3), "100,0,0")
    assert cli.main(["voxelise", "out/model.vtu", "--like", "scan.nrrd", "-o", "v.npy", "--device", "cpu"]) == 0
    assert "was reconstructed from projections" in capsys.readouterr().out
    places = [(np.arange(n) + 0.5) / n * side - side / 2 for n, side in ((10, 2), (8, 1.6), (6, 1.2))]
    np.testing.assert_allclose(np.load("v.npy"), linear(*places), atol=1e-5)


def test_a_volume_without_a_place_fills_the_mesh(model, capsys):
    assert cli.main(["voxelise", "model.vtu", "--like", "volume.npy", "-o", "v.npy", "--device", "cpu"]) == 0
    assert "tells no place" in capsys.readouterr().out
    places = [-1 + (np.arange(n) + 0.5) * 2 / n for n in (10, 8, 6)]
    np.testing.assert_allclose(np.load("v.npy"), linear(*places), atol=1e-5)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["-o", "v.npy"], "give either --like VOLUME or --shape"),
        (["-o", "v.npy", "--shape", "2", "2", "2", "--like", "volume.npy"], "give either --like VOLUME or --shape"),
        (["-o", "v.vti", "--shape", "2", "2", "2"], "use one of .npy, .nrrd, .nii"),
        (["-o", "v.npy", "--shape", "2", "0", "2"], "three numbers of at least 1"),
        (["-o", "v.nii", "--shape", "2", "40000", "2"], "at most 32,767 points along an axis"),
        (["-o", "v.npy", "--shape", "2", "2", "2", "--bounds", "0", "0", "0", "1", "0", "1"], "an upper corner"),
        (["-o", "v.npy", "--shape", "2", "2", "2", "--samples", "0"], "samples is 0"),
        (["-o", "v.npy", "--shape", "2", "2", "2", "--scalar", "heat"], "heat"),
        (["-o", "v.npy", "--like", "none.nrrd"], "There is no file 'none.nrrd'"),
    ],
)
def test_bad_voxels_are_one_sentence(model, capsys, words, sentence):
    assert sentence in fails(capsys, "voxelise", "model.vtu", *words)
    assert not list(model.parent.glob("v.*"))
