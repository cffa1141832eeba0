"""What projections say of themselves: counts that become line integrals, their noise, views that are held out."""

import json
import warnings

import numpy as np
import pytest
import torch

from difftetvr.capture import CaptureWarning, Noise, ProjectionCapture, ProjectionGeometry
from difftetvr.errors import CaptureError

GEOMETRY = ProjectionGeometry.from_dict(
    {
        "type": "cone",
        "views": 4,
        "source_distance": 5,
        "detector_distance": 7,
        "detector": [6, 5],
        "detector_size": [3, 3],
        "volume_size": 2,
        "unit": "mm",
    }
)
SHAPE = (4, 5, 6)
TRUE = torch.from_numpy(np.random.default_rng(0).random(SHAPE).astype(np.float32))


def test_counts_become_line_integrals_by_flat_and_dark_fields():
    random = np.random.default_rng(1)
    dark, gain = random.uniform(5, 10, (5, 6)), random.uniform(800, 1200, (5, 6))
    counts = dark + gain * np.exp(-TRUE.double().numpy())
    flats = (dark + gain) + np.array([-1.0, 0.0, 1.0])[:, None, None]
    capture = ProjectionCapture.from_intensities(GEOMETRY, counts, flats, dark, gaussian=3)
    torch.testing.assert_close(capture.line_integrals, TRUE, atol=1e-6, rtol=0)
    assert capture.valid is None and not capture.test.any()
    signal = counts - dark
    expected = (signal + 9) / signal**2 + 9 / signal**2 + (dark + gain + 9) / (3 * gain**2)
    np.testing.assert_allclose(capture.variance, expected, rtol=1e-5)


def test_the_variance_is_that_of_many_measurements():
    """Photons and electronics of a view and of a flat field, drawn 4000 times."""
    random = np.random.default_rng(2)
    views, flat, sigma = 500.0, 900.0, 12.0
    geometry = ProjectionGeometry.from_dict(
        {"type": "parallel", "views": 40, "detector": [10, 10], "detector_size": [2, 2]}
    )
    counts = random.poisson(views, (40, 10, 10)) + random.normal(0, sigma, (40, 10, 10))
    capture = ProjectionCapture.from_intensities(geometry, counts, flat, gaussian=sigma)
    # One flat field for all views is the same error everywhere, so that the spread is that of the views.
    assert float(capture.line_integrals.var()) == pytest.approx(views / views**2 + sigma**2 / views**2, rel=0.1)
    assert float(capture.line_integrals.mean()) == pytest.approx(np.log(flat / views), abs=0.005)


def test_masks_of_another_shape_are_refused_with_counts_too(tmp_path):
    counts = 1e3 * np.exp(-TRUE.numpy())
    text = json.dumps(GEOMETRY.to_dict())
    for shape in ((5, 6), (5, 6, 4), (4, 5)):
        for kind, array in (("intensities", counts), ("line_integrals", TRUE.numpy())):
            for valid in (np.ones(shape, bool), np.zeros(shape, bool)):
                np.savez(tmp_path / "scan.npz", geometry=text, flat=1e3, valid=valid, **{kind: array})
                with pytest.raises(CaptureError, match=r"mask 'valid' of 'scan' is .* pass bool of shape \(4, 5, 6\)"):
                    ProjectionCapture.load(tmp_path / "scan.npz")


def test_transmissions_have_the_noise_that_is_seen():
    """They are no photons: a variance of one over each would be ten thousand times too great."""
    geometry = ProjectionGeometry.from_dict(
        {"type": "parallel", "views": 6, "detector": [40, 30], "detector_size": [2, 2]}
    )
    smooth = np.linspace(0.0, 1.0, 40)[None, None] * np.ones((6, 30, 40))
    counts = np.random.default_rng(3).poisson(1e4 * np.exp(-smooth)).astype(np.float64)
    photons = ProjectionCapture.from_intensities(geometry, counts, 1e4)
    with pytest.warns(CaptureWarning, match="times that of one photon for each count"):
        relative = ProjectionCapture.from_intensities(geometry, counts / 1e4, 1.0)
    torch.testing.assert_close(relative.line_integrals, photons.line_integrals)
    # That of the views: one flat field is the same error everywhere, of which no pixel knows.
    assert float(relative.variance.mean()) == pytest.approx(float((1.0 / counts).mean()), rel=0.15)


def test_dead_pixels_and_those_that_count_nothing_are_left_out_and_counted():
    flat, counts = np.full((5, 6), 100.0), np.full(SHAPE, 50.0)
    flat[1, 2], flat[3, 3] = 0, np.nan
    counts[2, 0, 0], counts[0, 4, 5], counts[1, 1, 1] = 0, -3, np.inf
    with pytest.warns(CaptureWarning) as caught:
        capture = ProjectionCapture.from_intensities(GEOMETRY, counts, flat)
    said = [str(warning.message) for warning in caught]
    assert said == [
        "2 pixels of 30 of 'scan' see no light without an object, and are left out.",
        "3 pixels of 120 in all views of 'scan' count nothing, and are left out.",
    ]
    invalid = np.zeros(SHAPE, dtype=bool)
    invalid[:, 1, 2] = invalid[:, 3, 3] = invalid[2, 0, 0] = invalid[0, 4, 5] = invalid[1, 1, 1] = True
    np.testing.assert_array_equal(~capture.valid.numpy(), invalid)
    torch.testing.assert_close(capture.line_integrals, torch.full(SHAPE, float(np.log(2))))


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"counts": np.zeros(SHAPE)}, "No pixel of 'scan' counts more than its dark field"),
        ({"counts": np.ones((4, 5, 5))}, r"shape \(4, 5, 5\), but the geometry has \(4, 5, 6\)"),
        ({"flat": np.ones((4, 5))}, "flat field of 'scan' is an array of shape .* 5 x 6 pixels"),
        ({"flat": 0.0}, "nowhere brighter than its dark field"),
        ({"flat": 1.0, "dark": 2.0}, "nowhere brighter than its dark field"),
        ({"dark": "none"}, "dark field of 'scan'"),
        ({"counts": "counts"}, "pass an array of numbers"),
    ],
)
def test_counts_that_tell_nothing_are_refused(arguments, sentence):
    with pytest.raises(CaptureError, match=sentence):
        ProjectionCapture.from_intensities(
            **({"geometry": GEOMETRY, "counts": np.ones(SHAPE), "flat": 1.0} | arguments)
        )


def with_nan(*place: int) -> torch.Tensor:
    values = TRUE.clone()
    values[place] = float("nan")
    return values


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"line_integrals": TRUE[:3]}, r"shape \(3, 5, 6\), but the geometry has 4 views of 5 rows and 6 columns"),
        ({"line_integrals": with_nan(1, 2, 3)}, "hold nan in view 1 at row 2, column 3"),
        ({"line_integrals": "sinogram"}, "of real numbers"),
        ({"variance": TRUE - TRUE}, "variance of 'scan' must be greater than 0"),
        ({"variance": with_nan(0, 0, 0)}, "variance of 'scan' hold nan"),
        ({"valid": TRUE > 2}, "No pixel of 'scan' is valid"),
        ({"valid": TRUE}, "mask 'valid'"),
        ({"test": torch.ones(4, dtype=torch.bool)}, "All views of 'scan' are held out"),
        ({"test": torch.ones(3, dtype=torch.bool)}, "mask 'test'"),
        ({"geometry": None}, "pass a ProjectionGeometry"),
    ],
)
def test_what_is_no_capture_is_refused(arguments, sentence):
    with pytest.raises(CaptureError, match=sentence):
        ProjectionCapture(**({"geometry": GEOMETRY, "line_integrals": TRUE} | arguments))


def test_pixels_that_are_not_valid_may_hold_anything():
    values = with_nan(1, 2, 3)
    capture = ProjectionCapture(GEOMETRY, values, torch.ones(SHAPE), ~torch.isnan(values))
    assert int((~capture.valid).sum()) == 1


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
@pytest.mark.parametrize("bare", [True, False])
def test_files_hold_all_of_a_capture(tmp_path, suffix, bare):
    test = torch.tensor([False, True, False, False])
    more = {} if bare else {"variance": TRUE + 0.1, "valid": TRUE > 0.2, "test": test}
    capture = ProjectionCapture(GEOMETRY, TRUE, **more)
    capture.save(tmp_path / f"scan{suffix}")
    again = ProjectionCapture.load(tmp_path / f"scan{suffix}")
    for name in ("line_integrals", "variance", "valid", "test"):
        one, other = getattr(capture, name), getattr(again, name)
        assert (one is None and other is None) or torch.equal(one, other)
    assert again.geometry.to_dict() == GEOMETRY.to_dict() and again.name == "scan"
    assert again.train_indices.tolist() == ([0, 1, 2, 3] if bare else [0, 2, 3])


def test_views_are_held_out_from_the_middle_of_the_first_ones(tmp_path):
    ProjectionCapture(GEOMETRY, TRUE, test=torch.tensor([True, False, False, False])).save(tmp_path / "scan.npz")
    assert ProjectionCapture.load(tmp_path / "scan.npz", holdout_every=3).test.tolist() == [True, True, False, False]
    for wrong in (1, -2, 5, True, "two"):
        with pytest.raises(CaptureError, match="cannot be held out of 4"):
            ProjectionCapture.load(tmp_path / "scan.npz", holdout_every=wrong)


def test_some_views_are_a_capture_of_their_own():
    capture = ProjectionCapture(GEOMETRY, TRUE, TRUE + 1, test=torch.tensor([True, False, False, False]))
    some = capture.select([2, 0])
    assert torch.equal(some.line_integrals, TRUE[[2, 0]]) and torch.equal(some.variance, TRUE[[2, 0]] + 1)
    assert some.test.tolist() == [False, True] and some.valid is None
    assert torch.equal(some.geometry.detector.source, GEOMETRY.detector.source[[2, 0]])


def tigre_noise(clean: np.ndarray, photons: float, sigma: float, random: np.random.Generator) -> np.ndarray:
    """As the module ``CTnoise`` of TIGRE computes it."""
    greatest = clean.max()
    counts = random.poisson(photons * np.exp(-clean.astype(np.float64) / greatest)).astype(np.float64)
    counts = counts + random.normal(0, sigma, counts.shape)
    return np.float32(-np.log(counts / photons) * greatest)


def test_noise_is_that_of_tigre():
    clean = TRUE.repeat(1, 20, 20)
    found = Noise.parse("poisson:1e4,gaussian:10").apply(clean, seed=5)
    expected = tigre_noise(clean.numpy(), 1e4, 10, np.random.default_rng(5))
    np.testing.assert_allclose(found.line_integrals, expected, atol=1e-6)
    assert bool(found.valid.all())
    # And its variance is the one it has.
    error = (found.line_integrals - clean).double()
    assert float((error.square() / found.variance).mean()) == pytest.approx(1.0, abs=0.03)
    again, other = (Noise(1e4, 10).apply(clean, seed).line_integrals for seed in (5, 6))
    assert torch.equal(found.line_integrals, again) and not torch.equal(found.line_integrals, other)


def test_noise_in_plain_units_depends_on_the_pixel_alone():
    found = Noise.parse("poisson:1e6,scale:1").apply(torch.full((1, 60, 60), 3.0))
    assert float(found.variance.mean()) == pytest.approx(np.exp(3.0) / 1e6, rel=0.01)
    assert float(found.line_integrals.var()) == pytest.approx(np.exp(3.0) / 1e6, rel=0.1)


def test_pixels_without_a_count_are_not_valid():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = Noise(10.0, 0.0, 1.0).apply(torch.full((1, 30, 30), 4.0))
    assert 0.6 < float((~found.valid).double().mean()) < 0.95
    assert bool(torch.isfinite(found.line_integrals).all()) and bool((found.variance > 0).all())


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("poisson", "give it as 'poisson:1e4,gaussian:10'"),
        ("poisson:many", "give it as"),
        ("poisson:1,poisson:2", "give it as"),
        ("salt:3", "give it as"),
        ("poisson:-1", "photons of a pixel"),
        ("poisson:nan", "photons of a pixel"),
        ("gaussian:10", "give poisson:I0, too"),
        ("poisson:1e4,gaussian:-1", "counts of at least 0"),
        ("poisson:1e4,scale:0", "greater than 0"),
    ],
)
def test_noise_that_is_none_is_refused(text, sentence):
    with pytest.raises(CaptureError, match=sentence):
        Noise.parse(text)


def test_noise_needs_something_that_absorbs_and_a_seed():
    with pytest.raises(CaptureError, match="Nothing absorbs"):
        Noise(1e4).apply(torch.zeros(1, 2, 2))
    with pytest.raises(CaptureError, match="seed is -1"):
        Noise(1e4).apply(TRUE, seed=-1)
