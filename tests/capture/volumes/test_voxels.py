"""Values of volumes with the axes x, y, z, as projections and comparisons take them."""

import warnings

import numpy as np
import pytest

from difftetvr.capture import CaptureWarning, load_volume
from difftetvr.errors import CaptureError

VALUES = np.random.default_rng(0).random((3, 4, 5))  # z, y, x


def test_floats_are_what_the_file_holds(tmp_path):
    np.save(tmp_path / "v.npy", 7 * VALUES - 3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        volume = load_volume(tmp_path / "v.npy")
    np.testing.assert_allclose(volume.values, (7 * VALUES - 3).transpose(2, 1, 0), rtol=1e-6)
    assert volume.extent == (5, 4, 3) and volume.name == "v.npy" and volume.unit == ""


def test_integers_stand_for_fractions_of_their_range(tmp_path):
    counts = (1000 * VALUES).astype(np.int16)
    np.save(tmp_path / "v.npy", counts)
    low, high = counts.min(), counts.max()
    with pytest.warns(CaptureWarning, match=f"values {low} to {high} stand for 0 to 1; value_range says otherwise"):
        values = load_volume(tmp_path / "v.npy").values
    np.testing.assert_allclose(values, (counts.transpose(2, 1, 0) - low) / (high - low), atol=1e-6)
    np.save(tmp_path / "b.npy", (255 * VALUES).astype(np.uint8))
    with pytest.warns(CaptureWarning, match="values 0 to 255 stand for 0 to 1"):
        values = load_volume(tmp_path / "b.npy").values
    np.testing.assert_allclose(255 * values, (255 * VALUES).astype(np.uint8).T, atol=1e-4)


def test_a_range_clamps_floats_too(tmp_path):
    np.save(tmp_path / "v.npy", VALUES)
    with pytest.warns(CaptureWarning, match="are taken for its ends"):
        values = load_volume(tmp_path / "v.npy", value_range=(0.25, 0.75)).values
    np.testing.assert_allclose(values, np.clip((VALUES.T - 0.25) / 0.5, 0, 1), atol=1e-6)


def test_axes_of_the_file_become_those_of_the_world(tmp_path):
    head = ["NRRD0004", "type: float", "dimension: 3", "space: left-posterior-superior", "sizes: 5 4 3"]
    head += ["space directions: (0,-2,0) (1,0,0) (0,0,3)", "endian: little", "encoding: raw"]
    head += ['space units: "mm" "mm" "mm"', "", ""]
    (tmp_path / "v.nrrd").write_bytes("\n".join(head).encode() + VALUES.astype("<f4").tobytes())
    volume = load_volume(tmp_path / "v.nrrd")
    # x of the world is the second axis of the file; y the first one, reversed.
    np.testing.assert_array_equal(volume.values, VALUES.astype(np.float32).transpose(1, 2, 0)[:, ::-1])
    assert volume.spacing == (1, 2, 3) and volume.extent == (4, 10, 9) and volume.unit == "mm"


@pytest.mark.parametrize(
    ("values", "options", "sentence"),
    [
        (VALUES * np.nan, {}, "not finite numbers of 32 bits"),
        (VALUES * 1e300, {}, "not finite numbers of 32 bits"),
        (VALUES[0], {}, "2 dimensions"),
        (VALUES, {"value_range": (1, 0)}, "the smaller first"),
        (VALUES, {"value_range": "all"}, "value_range is 'all'"),
        (np.full((3, 3, 3), 7), {}, "All values of the volume"),
    ],
)
def test_what_is_no_volume_is_one_sentence(tmp_path, values, options, sentence):
    np.save(tmp_path / "v.npy", values)
    with pytest.raises(CaptureError, match=sentence):
        load_volume(tmp_path / "v.npy", **options)
