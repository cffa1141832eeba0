"""Lens distortion: the model, its inverse, and photographs freed from it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from difftetvr.capture.photos.lens import Distortion, Intrinsics
from difftetvr.capture.photos.undistort import pinhole_of, undistorted, undistorted_mask
from difftetvr.errors import CaptureError
from difftetvr.srgb import linear_to_srgb, srgb_to_linear

LENSES = {
    "barrel": Distortion(k1=-0.2, k2=0.03),
    "pincushion": Distortion(k1=0.15, k2=0.02),
    "tangential": Distortion(k1=0.05, p1=0.01, p2=-0.02),
    "rational": Distortion(k1=0.1, k2=-0.05, p1=1e-3, p2=2e-3, k3=0.01, k4=0.05, k5=0.02, k6=0.003),
    "fox": Distortion(k1=0.0578421, k2=-0.0805099, p1=-0.000980296, p2=0.00015575),
}
GRID = np.stack(np.meshgrid(np.linspace(-0.7, 0.7, 29), np.linspace(-0.5, 0.5, 21)), axis=-1)


def lens(distortion: Distortion) -> Intrinsics:
    return Intrinsics(110.0, 108.0, 78.0, 51.0, 160, 100, distortion)


def test_model_by_hand() -> None:
    # r2 = 0.25, so g = (1 + 0.1 / 4 + 0.2 / 16 + 0.3 / 64) / (1 + 0.4 / 4 + 0.5 / 16 + 0.6 / 64).
    d = Distortion(k1=0.1, k2=0.2, p1=0.01, p2=0.02, k3=0.3, k4=0.4, k5=0.5, k6=0.6)
    g = (1 + 0.025 + 0.0125 + 0.0046875) / (1 + 0.1 + 0.03125 + 0.009375)
    expected = [0.3 * g + 0.02 * 0.12 + 0.02 * (0.25 + 0.18), 0.4 * g + 0.01 * (0.25 + 0.32) + 0.04 * 0.12]
    np.testing.assert_allclose(d.distort(np.array([0.3, 0.4])), expected, rtol=1e-14)
    np.testing.assert_allclose(Distortion(k1=0.1).distort(np.array([0.0, 1.0])), [0, 1.1])
    assert Distortion().is_none and not d.is_none


@pytest.mark.parametrize("distortion", LENSES.values(), ids=LENSES)
def test_inverse(distortion: Distortion) -> None:
    np.testing.assert_allclose(distortion.undistort(distortion.distort(GRID)), GRID, atol=1e-12)


@pytest.mark.parametrize("distortion", LENSES.values(), ids=LENSES)
def test_jacobian_is_the_derivative(distortion: Distortion) -> None:
    _, (a, b, c, d) = distortion._distort_with_jacobian(GRID)
    step = 1e-6
    for axis, (x, y) in enumerate(((a, c), (b, d))):
        shift = step * np.eye(2)[axis]
        difference = (distortion.distort(GRID + shift) - distortion.distort(GRID - shift)) / (2 * step)
        np.testing.assert_allclose(difference, np.stack([x, y], axis=-1), atol=1e-8)


def test_points_beyond_a_fold_are_not_found() -> None:
    # x (1 - x^2) is at most 0.385.
    inverse = Distortion(k1=-1.0).undistort(np.array([[0.3, 0.0], [0.4, 0.0]]))
    np.testing.assert_allclose(inverse[0], [0.3389, 0], atol=1e-4)
    assert np.isnan(inverse[1]).all()
    with pytest.raises(CaptureError, match="folds the image"):
        pinhole_of(lens(Distortion(k1=-1.0)), "this")


@pytest.mark.parametrize("distortion", LENSES.values(), ids=LENSES)
def test_pinhole_sees_all_it_can_but_nothing_beyond(distortion: Distortion) -> None:
    source = lens(distortion)
    pinhole = pinhole_of(source, "this")
    assert pinhole.distortion.is_none and (pinhole.width, pinhole.height) == (160, 100)
    pixels = np.stack(np.meshgrid(np.linspace(0, 160, 161), np.linspace(0, 100, 101)), axis=-1)
    seen = source.to_pixels(distortion.distort(pinhole.to_normalised(pixels)))
    assert (seen > -0.01).all() and (seen < (160.01, 100.01)).all()
    # Each edge touches the photograph's.
    assert seen[:, 0, 0].min() < 0.1 and seen[:, -1, 0].max() > 159.9
    assert seen[0, :, 1].min() < 0.1 and seen[-1, :, 1].max() > 99.9


def pattern(normalised: np.ndarray) -> torch.Tensor:
    """(H, W, 3) smooth linear light as a function of undistorted coordinates."""
    x, y = normalised[..., 0], normalised[..., 1]
    light = np.stack([0.5 + 0.4 * np.sin(8 * x), 0.5 + 0.4 * np.cos(9 * y), 0.5 + 0.4 * np.sin(5 * (x + y))], axis=-1)
    return torch.from_numpy(light.astype(np.float32))


def pixel_centers() -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(160) + 0.5, np.arange(100) + 0.5), axis=-1)


@pytest.mark.parametrize("distortion", LENSES.values(), ids=LENSES)
def test_photographs_become_what_the_pinhole_sees(distortion: Distortion) -> None:
    source = lens(distortion)
    pinhole = pinhole_of(source, "this")
    photo = linear_to_srgb(pattern(distortion.undistort(source.to_normalised(pixel_centers()))))
    truth = linear_to_srgb(pattern(pinhole.to_normalised(pixel_centers())))
    result = undistorted(photo, source, pinhole)
    error = (result - truth)[2:-2, 2:-2].abs()
    # What bicubic interpolation of so coarse an image leaves, a tenth of a grey level.
    assert float(error.max()) < 3e-3 and float(error.mean()) < 6e-4
    # Half a pixel of shift, the usual mistake, would be seen.
    shifted = undistorted(torch.roll(photo, 1, dims=1), source, pinhole)
    assert float((shifted - truth)[2:-2, 2:-2].abs().mean()) > 5e-3


def test_alpha_is_interpolated_as_stored_and_stays_above_colour() -> None:
    source = lens(LENSES["pincushion"])
    pinhole = pinhole_of(source, "this")
    alpha = (torch.rand(100, 160, generator=torch.Generator().manual_seed(0)) > 0.5).float()[..., None]
    result = undistorted(torch.cat([alpha.expand(-1, -1, 3), alpha], dim=-1), source, pinhole)
    assert result.shape == (100, 160, 4) and bool((result[..., :3] <= result[..., 3:]).all())
    assert float(result.min()) >= 0 and float(result.max()) <= 1
    opaque = undistorted(torch.ones(100, 160, 4), source, pinhole)
    assert torch.allclose(opaque, torch.ones(()), atol=1e-5)


def test_masks_exclude_whatever_touches_an_excluded_pixel() -> None:
    source = lens(LENSES["tangential"])
    pinhole = pinhole_of(source, "this")
    mask = torch.ones(100, 160, dtype=torch.bool)
    mask[40:60, 70:90] = False
    result = undistorted_mask(mask, source, pinhole)
    marked = undistorted(
        torch.cat([(~mask).float()[..., None].expand(-1, -1, 3), torch.ones(100, 160, 1)], -1), source, pinhole
    )
    assert not bool(result[marked[..., 0] > 1e-3].any())
    assert 300 < int((~result).sum()) < 800
    assert bool(undistorted_mask(torch.ones_like(mask), source, pinhole).all())


def test_transfer_curve() -> None:
    values = torch.linspace(0, 1, 1001)
    assert torch.allclose(linear_to_srgb(srgb_to_linear(values)), values, atol=1e-6)
    assert float(srgb_to_linear(torch.tensor(0.5))) == pytest.approx(0.21404, abs=1e-5)
    assert float(srgb_to_linear(torch.tensor(0.02))) == pytest.approx(0.02 / 12.92)
