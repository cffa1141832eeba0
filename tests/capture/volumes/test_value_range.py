"""From stored values to scalars: which of them stand for 0 and 1, what is said of that, and views that show nothing."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import numpy as np
import pytest

from difftetvr.capture import Volume, VolumeCapture
from difftetvr.capture.volumes.summary import summarise
from difftetvr.capture.volumes.value_range import normalise
from difftetvr.errors import CaptureError, CaptureWarning


def saved(folder: Path, values: np.ndarray) -> Path:
    np.save(folder / "v.npy", values)
    return folder / "v.npy"


def load(path: Path, **options) -> tuple[Volume, list[str]]:
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        volume = Volume.load(path, **options)
    assert all(warning.category is CaptureWarning for warning in said)
    return volume, [str(warning.message) for warning in said]


def ramp(low: float, high: float, dtype: str) -> np.ndarray:
    return np.linspace(low, high, 24).reshape(2, 3, 4).astype(dtype)


@pytest.mark.parametrize("dtype", ["uint16", "int16", "int8", "uint32", "int64", "float16", "float32", "float64"])
def test_the_least_and_the_greatest_value_stand_for_0_and_1_which_is_said(tmp_path: Path, dtype: str) -> None:
    values = ramp(5, 120, dtype)
    volume, said = load(saved(tmp_path, values))
    np.testing.assert_allclose(volume.values, (values.astype(np.float64) - 5) / 115, rtol=1e-6)
    assert volume.value_range == (5, 120) and (volume.values.min(), volume.values.max()) == (0, 1)
    assert len(said) == 1
    assert "values 5 to 120 stand for 0 to 1 of the transfer function; --value-range says otherwise." in said[0]


def test_bytes_stay_as_they_are_to_the_bit(tmp_path: Path) -> None:
    values = np.arange(256, dtype=np.uint8).reshape(4, 8, 8)
    volume, said = load(saved(tmp_path, values))
    assert np.array_equal(volume.values, values / np.float32(255)) and volume.value_range == (0, 255) and not said
    assert np.array_equal(load(saved(tmp_path, values.astype(np.int32)), value_range=(0, 255))[0].values, volume.values)


def test_all_of_uint16_is_as_ever(tmp_path: Path) -> None:
    values = np.array([0, 1, 4095, 65535] * 2, np.uint16).reshape(2, 2, 2)
    assert np.array_equal(load(saved(tmp_path, values))[0].values, values / np.float32(65535))


def test_values_that_are_scalars_already_need_no_word(tmp_path: Path) -> None:
    assert load(saved(tmp_path, ramp(0, 1, "float32")))[1] == []
    assert load(saved(tmp_path, ramp(0, 1, "float32") > 0.5))[1] == []


def test_a_given_range_clamps_and_counts(tmp_path: Path) -> None:
    path = saved(tmp_path, np.array([-2000, -1024, 0, 3071, 3072, 9000, 1, 2], np.int16).reshape(2, 2, 2))
    volume, said = load(path, value_range=(-1024, 3071))
    np.testing.assert_allclose(volume.values.ravel()[:6], [0, 0, 1024 / 4095, 1, 1, 1])
    assert len(said) == 1 and "3 of 8 values" in said[0] and "-1024 to 3071 and are taken for its ends" in said[0]


def test_small_differences_far_from_zero_survive(tmp_path: Path) -> None:
    values = 1e6 + ramp(0, 0.01, "float64")
    np.testing.assert_allclose(load(saved(tmp_path, values))[0].values, ramp(0, 1, "float64"), atol=1e-7)


@pytest.mark.parametrize(
    "dtype, offset", [("int64", 1_700_000_000_000_000_000), ("int64", -(2**63)), ("uint64", 2**63)]
)
def test_integers_that_float64_would_round(tmp_path: Path, dtype: str, offset: int) -> None:
    """Of times in nanoseconds, float64 knows every 256th only."""
    steps = np.random.default_rng(0).permutation(24).reshape(2, 3, 4)
    values = np.array([offset + int(step) for step in steps.ravel()], dtype).reshape(steps.shape)
    volume, said = load(saved(tmp_path, values))
    assert np.array_equal(volume.values, (steps / 23).astype(np.float32))
    assert (
        volume.value_range == (offset, offset + 23) and f"values {offset} to {offset + 23} stand for 0 to 1" in said[0]
    )
    assert summarise(tmp_path / "v.npy").ends == (offset, offset + 23)
    # Ends that are given as whole numbers are not rounded, either.
    volume, said = load(tmp_path / "v.npy", value_range=(offset + 3, offset + 13))
    np.testing.assert_allclose(volume.values, np.clip((steps - 3) / 10, 0, 1), atol=1e-7)
    assert "13 of 24 values" in said[0]
    head = f"NRRD0004\ntype: {dtype}\ndimension: 3\nsizes: 4 3 2\nencoding: text\n\n"
    (tmp_path / "v.nrrd").write_text(head + " ".join(map(str, values.ravel().tolist())))
    assert np.array_equal(load(tmp_path / "v.nrrd")[0].values, (steps / 23).astype(np.float32))


def test_all_of_64_bits(tmp_path: Path) -> None:
    values = np.array([-(2**63), -1, 0, 1, 2**62, 2**63 - 1, 5, 7], np.int64).reshape(2, 2, 2)
    exact = (values.astype(np.float64) + 2.0**63) / 2.0**64
    np.testing.assert_allclose(load(saved(tmp_path, values))[0].values, exact, atol=1e-7)
    volume, said = load(tmp_path / "v.npy", value_range=(0.5, 5.5))
    np.testing.assert_allclose(volume.values, np.clip((values - 0.5) / 5, 0, 1), atol=1e-7)
    assert "6 of 8 values" in said[0]
    # Ends beyond what the type can hold.
    np.testing.assert_allclose(
        load(tmp_path / "v.npy", value_range=(-(2.0**64), 2**64))[0].values, exact / 2 + 0.25, atol=1e-7
    )


def test_ranges_at_the_end_of_float64(tmp_path: Path) -> None:
    values = ramp(-1.7, 1.7, "float64") * 1e308
    np.testing.assert_allclose(load(saved(tmp_path, values))[0].values, ramp(0, 1, "float64"), atol=1e-6)


def test_what_is_not_a_number_counts_as_the_least_which_is_said(tmp_path: Path) -> None:
    values = ramp(1, 2, "float32")
    values[0, 0, 0], values[0, 0, 3], values[1, 1, 1], values[1, 2, 3] = np.inf, np.nan, np.nan, -np.inf
    volume, said = load(saved(tmp_path, values))
    assert volume.values[0, 0, 3] == volume.values[1, 1, 1] == volume.values[1, 2, 3] == 0
    assert volume.values[0, 0, 0] == 1 and np.isfinite(volume.values).all()
    assert any("2 values of" in line and "not a number (NaN), taken for the least one" in line for line in said)
    assert any("2 of 24 values" in line and "taken for its ends" in line for line in said)
    assert len(said) == 3


@pytest.mark.parametrize(
    "value_range, message",
    [((1, 1), "smaller first"), ((2, 1), "smaller first"), ((0, float("inf")), "finite"), ((0,), "two"), ("ab", "two")],
)
def test_a_range_must_be_one(tmp_path: Path, value_range, message: str) -> None:
    with pytest.raises(CaptureError, match=message):
        Volume.load(saved(tmp_path, ramp(0, 9, "int16")), value_range=value_range)


def test_volumes_without_a_range_are_refused(tmp_path: Path) -> None:
    path = saved(tmp_path, np.full((2, 3, 4), -1000, np.int16))
    with pytest.raises(CaptureError, match=r"All values .* are -1000; there is no range to see, unless --value-range"):
        Volume.load(path)
    assert float(load(path, value_range=(-2000, 0))[0].values.mean()) == 0.5
    with pytest.raises(CaptureError, match=r"No value .* is finite"):
        Volume.load(saved(tmp_path, np.full((2, 3, 4), np.nan)))


def test_range_does_not_depend_on_the_order_of_layers() -> None:
    values = ramp(0, 100, "float32")
    values[1] = np.nan
    assert normalise(values, None, "v").value_range == normalise(values[::-1], None, "v").value_range


def scene(folder: Path, dtype: str) -> VolumeCapture:
    """A soft ball of values up to 4095, and a transfer function that shows those above a third of the range."""
    x = np.linspace(-1, 1, 12)
    ball = np.clip(1 - np.sqrt(x[:, None, None] ** 2 + x[None, :, None] ** 2 + x[None, None, :] ** 2), 0, 1)
    function = {"scalar": [0, 0.3, 1], "opacity": [0, 0, 1], "color": [[0, 0, 0], [1, 0.6, 0.3], [1, 1, 1]]}
    (folder / "tf.json").write_text(json.dumps(function))
    path = saved(folder, (ball * 4095).astype(dtype))
    return VolumeCapture(str(path), transfer_function=str(folder / "tf.json"), views=3, width=12, height=12)


def test_12_bits_in_16_are_seen(tmp_path: Path) -> None:
    with pytest.warns(CaptureWarning, match="stand for 0 to 1"):
        capture = scene(tmp_path, "uint16").build(device="cpu")
    assert float(capture.images.max()) > 0.3


def test_views_that_show_nothing_are_an_error(tmp_path: Path) -> None:
    settings = {**scene(tmp_path, "uint16").__dict__, "value_range": (0, 65535)}
    with pytest.raises(CaptureError, match=r"All views of .* are black: .*tf\.json' shows .* values 0 to 65535 stand"):
        VolumeCapture(**settings).build(device="cpu")


def test_summary_tells_what_to_choose_a_range_from(tmp_path: Path) -> None:
    values = np.arange(2 * 30 * 50, dtype=np.float32).reshape(2, 30, 50) - 1000
    values[0, 0, 7] = np.nan
    summary = summarise(saved(tmp_path, values), spacing=(1, 2, 3))
    assert (summary.resolution, summary.spacing, summary.dtype) == ((50, 30, 2), (1, 2, 3), "float32")
    assert (summary.missing, summary.ends, summary.value_range) == (1, (-1000, 1999), (-1000, 1999))
    assert summary.quantiles[0.5] == pytest.approx(500, abs=1) and summary.quantiles[0.01] == pytest.approx(-970, abs=1)


def test_summary_of_what_cannot_be_seen(tmp_path: Path) -> None:
    summary = summarise(saved(tmp_path, np.full((2, 3, 4), 7, np.int16)))
    assert (summary.ends, summary.value_range, summary.quantiles[0.99]) == ((7, 7), None, 7)
    summary = summarise(saved(tmp_path, np.full((2, 3, 4), np.nan)))
    assert (summary.ends, summary.value_range, summary.missing, summary.quantiles) == (None, None, 24, {})
