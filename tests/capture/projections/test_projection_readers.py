"""Files of projections, as other programs write them, and as nobody should."""

import json
import pickle
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from difftetvr.capture import CaptureWarning, ProjectionCapture, ProjectionGeometry, is_projection_source
from difftetvr.errors import CaptureError

VALUES = np.random.default_rng(0).random((3, 5, 6)).astype(np.float32)
CONE = {
    "type": "cone",
    "views": 3,
    "source_distance": 5,
    "detector_distance": 7,
    "detector": [6, 5],
    "detector_size": [3, 2.5],
    "volume_size": 2,
}
SCANNER = {  # as R2-Gaussian's cone_beam.yml has it
    "mode": "cone",
    "filter": None,
    "DSD": 7.0,
    "DSO": 5.0,
    "nDetector": [5, 6],
    "sDetector": [2.5, 3.0],
    "nVoxel": [8, 9, 10],
    "sVoxel": [2.0, 1.8, 1.6],
    "offOrigin": [0.1, 0, -0.1],
    "offDetector": [0.2, -0.3],
    "accuracy": 0.5,
    "totalAngle": 360.0,
    "startAngle": 0.0,
    "noise": True,
    "possion_noise": 10000,
    "gaussian_noise": [0, 10],
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder as R2-Gaussian's generator writes it, with two views to train on and one to test with."""
    meta: dict = {"scanner": SCANNER, "vol": "vol_gt.npy", "bbox": [[-1, -1, -1], [1, 1, 1]]}
    for split, numbers in (("proj_train", (0, 1)), ("proj_test", (2,))):
        (tmp_path / split).mkdir()
        meta[split] = []
        for number, index in enumerate(numbers):
            name = f"{split}/{split}_{number:04d}.npy"
            np.save(tmp_path / name, VALUES[index])
            meta[split].append({"file_path": name, "angle": 2.0 * index})
    (tmp_path / "meta_data.json").write_text(json.dumps(meta))
    return tmp_path


def test_folders_of_r2_gaussian(folder):
    with pytest.warns(CaptureWarning, match="those of TIGRE's noise, 10000 photons and 10 counts"):
        capture = ProjectionCapture.load(folder)
    np.testing.assert_array_equal(capture.line_integrals, VALUES)
    assert capture.test.tolist() == [False, False, True]
    own = CONE | {"views": None, "angles": np.rad2deg([0, 2, 4]).tolist(), "detector_offset": [0.2, -0.3]}
    own |= {"volume_size": [2.0, 1.8, 1.6], "volume_offset": [0.1, 0, -0.1]}
    expected = ProjectionGeometry.from_dict({k: v for k, v in own.items() if v is not None})
    for name in ("source", "center", "columns", "rows"):
        torch.testing.assert_close(getattr(capture.geometry.detector, name), getattr(expected.detector, name))
    torch.testing.assert_close(capture.geometry.bounds, expected.bounds)
    greatest = VALUES[:2].max()
    counts = 1e4 * np.exp(-VALUES / greatest)
    np.testing.assert_allclose(capture.variance, greatest**2 * (counts + 100) / counts**2, rtol=1e-4)
    assert is_projection_source(folder) and not is_projection_source(folder / "proj_train")


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda f, m: m.pop("scanner"), "lacks the entry 'scanner'"),
        (lambda f, m: m.pop("proj_train") and m.pop("proj_test"), "names no projections in proj_train"),
        (lambda f, m: m["scanner"].update(DSD=4), "DSD 4 and DSO 5"),
        (lambda f, m: m["proj_train"][0].update(angle="zero"), "'angle'"),
        (lambda f, m: m["proj_train"][0].update(file_path="../secret.npy"), "lies outside of its folder"),
        (lambda f, m: m["proj_train"][0].update(file_path="x.npy"), "which is not there"),
        (lambda f, m: m["proj_train"][0].update(file_path="x.pickle"), "which is no .npy"),
        (lambda f, m: np.save(f / "proj_train/proj_train_0000.npy", VALUES[0, :2]), "needs 5 x 6 numbers"),
        (lambda f, m: np.save(f / "proj_train/proj_train_0000.npy", VALUES[0].astype(object)), "plain numpy array"),
        (lambda f, m: m.update(proj_train=[1]), "a list of objects"),
    ],
)
def test_bad_folders_are_one_sentence(folder, change, sentence):
    meta = json.loads((folder / "meta_data.json").read_text())
    change(folder, meta)
    (folder / "meta_data.json").write_text(json.dumps(meta))
    with pytest.raises(CaptureError, match=sentence):
        ProjectionCapture.load(folder)


def test_arrays_with_a_geometry_beside_them(tmp_path):
    np.save(tmp_path / "a.npy", VALUES)
    (tmp_path / "a.json").write_text(json.dumps(CONE))
    assert is_projection_source(tmp_path / "a.npy")
    np.testing.assert_array_equal(ProjectionCapture.load(tmp_path / "a.npy").line_integrals, VALUES)
    # ASTRA has rows before views.
    np.save(tmp_path / "b.npy", np.ascontiguousarray(VALUES.transpose(1, 0, 2)))
    cone = {"type": "cone", "DetectorSpacingX": 0.5, "DetectorSpacingY": 0.5, "DetectorColCount": 6}
    cone |= {"DetectorRowCount": 5, "ProjectionAngles": [0, 1, 2], "DistanceOriginSource": 5}
    cone |= {"DistanceOriginDetector": 2}
    volume = {"GridRowCount": 2, "GridColCount": 2, "GridSliceCount": 2}
    (tmp_path / "astra.json").write_text(json.dumps({"proj_geom": cone, "vol_geom": volume}))
    capture = ProjectionCapture.load(tmp_path / "b.npy", geometry=tmp_path / "astra.json")
    np.testing.assert_array_equal(capture.line_integrals, VALUES)
    assert not is_projection_source(tmp_path / "b.npy")
    with pytest.raises(CaptureError, match=r"there is no file '.*b\.json'"):
        ProjectionCapture.load(tmp_path / "b.npy")
    with pytest.raises(CaptureError, match="the array needs rows, views and columns"):
        ProjectionCapture.load(tmp_path / "a.npy", geometry=tmp_path / "astra.json")


def test_sinograms_of_a_slice_have_two_axes(tmp_path):
    np.save(tmp_path / "a.npy", VALUES[:, 0])
    (tmp_path / "a.json").write_text(json.dumps(CONE | {"type": "fan", "detector": 6, "detector_size": 3}))
    np.testing.assert_array_equal(ProjectionCapture.load(tmp_path / "a.npy").line_integrals, VALUES[:, :1])


def test_our_files_may_be_made_by_hand(tmp_path):
    counts = 1000 * np.exp(-VALUES)
    np.savez(tmp_path / "a.npz", geometry=json.dumps(CONE), intensities=counts, flat=1000.0, valid=VALUES > 0.1)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["geometry"] = json.dumps(CONE)
        file["intensities"], file["flat"], file["valid"] = counts, 1000.0, VALUES > 0.1
    for suffix in (".npz", ".h5"):
        capture = ProjectionCapture.load(tmp_path / f"a{suffix}", gaussian=2)
        np.testing.assert_allclose(capture.line_integrals[capture.valid], VALUES[VALUES > 0.1], atol=1e-6)
        assert torch.equal(capture.valid, torch.from_numpy(VALUES > 0.1))
        assert is_projection_source(tmp_path / f"a{suffix}")


def exchange(path: Path, **changes: object) -> Path:
    parts = {
        "data": 10 + 990 * np.exp(-VALUES),
        "data_white": np.full((4, 5, 6), 1000.0),
        "data_dark": np.full((2, 5, 6), 10.0),
        "theta": np.array([0.0, 60, 120]),
    } | changes
    with h5py.File(path, "w") as file:
        for name, values in parts.items():
            if values is not None:
                file[f"exchange/{name}"] = values
    return path


def test_data_exchange_of_synchrotrons(tmp_path):
    capture = ProjectionCapture.load(exchange(tmp_path / "a.h5"), center=2.5, pixel_size=0.5, unit="mm")
    np.testing.assert_allclose(capture.line_integrals, VALUES, atol=1e-6)
    geometry = capture.geometry
    assert geometry.unit == "mm" and geometry.angles.tolist() == pytest.approx([0, 60, 120])
    # 2.5 pixels are left of the axis and 3.5 right: all views see what is within 2.5.
    np.testing.assert_allclose(geometry.bounds, [[-1.25, -1.25, -1.25], [1.25, 1.25, 1.25]])
    detector = geometry.view(1)
    pixel = detector.center + (0 + 0.5 - 3) * detector.columns
    turned = np.deg2rad(60)
    np.testing.assert_allclose(pixel, -1.0 * np.array([-np.sin(turned), np.cos(turned), 0]), atol=1e-12)


def test_sinograms_by_hand_may_have_masks_of_two_axes(tmp_path):
    text = json.dumps(
        {
            "type": "fan",
            "views": 3,
            "source_distance": 5,
            "detector_distance": 7,
            "detector": 6,
            "detector_size": 4,
            "volume_size": 2,
        }
    )
    valid = np.ones((3, 6), bool)
    valid[1, 2] = False
    np.savez(
        tmp_path / "slice.npz", geometry=text, line_integrals=np.ones((3, 6)), variance=np.ones((3, 6)), valid=valid
    )
    loaded = ProjectionCapture.load(tmp_path / "slice.npz")
    assert loaded.valid.shape == (3, 1, 6) and not loaded.valid[1, 0, 2] and loaded.variance.shape == (3, 1, 6)


def test_what_data_exchange_leaves_out_is_assumed_and_said(tmp_path):
    with pytest.warns(CaptureWarning) as caught:
        capture = ProjectionCapture.load(exchange(tmp_path / "a.h5", theta=None, data_dark=None))
    said = " ".join(str(warning.message) for warning in caught)
    assert "taken as 0" in said and "evenly over 180 degrees" in said and "3 pixels from the left edge" in said
    assert capture.geometry.angles.tolist() == pytest.approx([0, 60, 120]) and capture.geometry.unit is None


def test_angles_without_a_unit_that_could_be_radians_are_told_of(tmp_path):
    path = exchange(tmp_path / "a.h5", theta=np.array([0.0, 1.05, 2.1]))
    with pytest.warns(CaptureWarning, match="have no unit and span 2.1; they are taken as degrees"):
        assert ProjectionCapture.load(path, center=3).geometry.angles.tolist() == pytest.approx([0, 1.05, 2.1])


@pytest.mark.parametrize(
    ("changes", "options", "sentence"),
    [
        ({"data": VALUES[0]}, {}, "needs views, rows and columns"),
        ({"data_white": None}, {}, "no 'exchange/data_white'"),
        ({"theta": np.zeros(2)}, {}, "2 angles for 3 views"),
        ({"theta": np.array([0, np.nan, 1])}, {}, "a finite one for each"),
        ({"data_white": np.ones((4, 5, 5))}, {"center": 3}, "flat field"),
        ({}, {"center": 40}, "lies outside of 6 pixels"),
        ({}, {"center": float("nan")}, "center is nan"),
        ({}, {"pixel_size": 0}, "pixel_size is 0"),
        ({}, {"axis": 3}, "no setting 'axis'; known are geometry, center"),
        ({}, {"geometry": "g.json"}, "leave out geometry"),
    ],
)
@pytest.mark.filterwarnings("ignore::difftetvr.errors.CaptureWarning")
def test_bad_data_exchange_is_one_sentence(tmp_path, changes, options, sentence):
    with pytest.raises(CaptureError, match=sentence):
        ProjectionCapture.load(exchange(tmp_path / "a.h5", **changes), **options)


def test_the_tooth_of_tomopy(shared_data):
    capture = ProjectionCapture.load(shared_data / "tomo" / "tooth.h5", center=296.0, holdout_every=10)
    assert capture.geometry.shape == (181, 2, 640) and int(capture.test.sum()) == 18
    assert capture.geometry.angles[-1].item() == pytest.approx(180 * 180 / 181, abs=1e-6)
    assert 1.0 < float(capture.line_integrals.quantile(0.999)) < 4.0
    assert abs(float(capture.line_integrals[:, :, :20].mean())) < 0.05  # air


def written(path: Path, **arrays: object) -> Path:
    np.savez(path, **arrays)
    return path


GEOMETRY = json.dumps(CONE)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda p: p / "none.h5", "There is no file"),
        (lambda p: p, "a folder without meta_data.json"),
        (lambda p: Path(p / "a.pickle").write_bytes(pickle.dumps({})) and p / "a.pickle", "is a pickle of Python"),
        (lambda p: Path(p / "a.dat").write_bytes(b"1") and p / "a.dat", "no file of projections that can be read"),
        (lambda p: Path(p / "a.h5").write_bytes(b"1234") and p / "a.h5", "cannot be read as projections"),
        (lambda p: Path(p / "a.npz").write_bytes(b"1234") and p / "a.npz", "no intact numpy archive"),
        (lambda p: written(p / "a.npz", line_integrals=VALUES), "has no 'geometry'"),
        (lambda p: written(p / "a.npz", geometry=GEOMETRY), "either 'line_integrals' or 'intensities'"),
        (lambda p: written(p / "a.npz", geometry=GEOMETRY, intensities=VALUES), "intensities without 'flat'"),
        (lambda p: written(p / "a.npz", geometry="{", line_integrals=VALUES), "is no JSON"),
        (lambda p: written(p / "a.npz", geometry=GEOMETRY, line_integrals=VALUES[:2]), "has 3 views of 5 rows"),
        (lambda p: written(p / "a.npz", geometry=GEOMETRY, line_integrals=VALUES * np.nan), "hold nan in view 0"),
        (lambda p: written(p / "a.npz", geometry=np.array({}, object), line_integrals=VALUES), "plain arrays"),
    ],
)
def test_what_is_no_scan_is_one_sentence(tmp_path, make, sentence):
    with pytest.raises(CaptureError, match=sentence) as caught:
        ProjectionCapture.load(make(tmp_path))
    assert "\n" not in str(caught.value) and str(caught.value).endswith(".")


def test_hdf5_without_projections_is_refused(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["volume"] = VALUES
    with pytest.raises(CaptureError, match="holds neither 'geometry'"):
        ProjectionCapture.load(tmp_path / "a.h5")
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["geometry"] = h5py.ExternalLink("a.h5", "volume")
        file["line_integrals"] = VALUES
    with pytest.raises(CaptureError, match="no text"):
        ProjectionCapture.load(tmp_path / "b.h5")


def test_announced_sizes_are_held_against_memory(tmp_path):
    """A few bytes of HDF5 may announce any number of pixels."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["geometry"] = GEOMETRY
        file.create_dataset("line_integrals", (10**5, 10**4, 10**4), "f4", chunks=(1, 64, 64), compression="gzip")
    with pytest.raises(CaptureError, match=r"would take .* of memory can be used"):
        ProjectionCapture.load(tmp_path / "a.h5")


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"valid": np.full((3, 6), 0.5)}, "mask 'valid' .* more than 0 and 1"),
        ({"valid": np.full((3, 6), np.nan)}, "mask 'valid' .* more than 0 and 1"),
        ({"Valid": np.ones((3, 6), bool)}, "'Valid', which is no array of a scan; rename or remove it"),
        ({"mask": np.ones((3, 6), bool)}, "'mask', which is no array of a scan"),
    ],
)
def test_masks_that_would_be_passed_over_are_refused(tmp_path, changed, sentence):
    geometry = {"type": "fan", "views": 3, "source_distance": 5, "detector_distance": 7, "detector": 6}
    text = json.dumps(geometry | {"detector_size": 4, "volume_size": 2})
    arrays = {"line_integrals": np.ones((3, 6)), "variance": np.ones((3, 6))}
    np.savez(tmp_path / "slice.npz", geometry=text, **(arrays | changed))
    with pytest.raises(CaptureError, match=sentence):
        ProjectionCapture.load(tmp_path / "slice.npz")
    with h5py.File(tmp_path / "slice.h5", "w") as file:
        file["geometry"] = text
        for name, array in (arrays | changed).items():
            file[name] = array
    with pytest.raises(CaptureError, match=sentence):
        ProjectionCapture.load(tmp_path / "slice.h5")
    np.savez(tmp_path / "slice.npz", geometry=text, valid=np.eye(3, 6), **arrays)
    assert ProjectionCapture.load(tmp_path / "slice.npz").valid.sum() == 3
