"""Lens distortion: the model, its inverse, and photographs freed from it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from difftetvr.capture.photos.undistort import known_pixels, pinhole_of, undistorted, undistorted_mask
from difftetvr.errors import CaptureError
from difftetvr.rendering.cameras.intrinsics import Intrinsics
from difftetvr.rendering.cameras.lenses.distortion import Distortion
from difftetvr.srgb import linear_to_srgb, srgb_to_linear


def opencv(**values: float) -> Distortion:
    return Distortion.named("opencv", values)


LENSES = {
    "barrel": opencv(k1=-0.2, k2=0.03),
    "pincushion": opencv(k1=0.15, k2=0.02),
    "tangential": opencv(k1=0.05, p1=0.01, p2=-0.02),
    "rational": opencv(k1=0.1, k2=-0.05, p1=1e-3, p2=2e-3, k3=0.01, k4=0.05, k5=0.02, k6=0.003),
    "fox": opencv(k1=0.0578421, k2=-0.0805099, p1=-0.000980296, p2=0.00015575),
    "prism": opencv(k1=-0.1, s1=0.01, s2=-0.02, s3=0.02, s4=0.01),
    "tilt": opencv(k1=-0.1, p1=0.01, tau_x=0.1, tau_y=-0.05),
    "nerfstudio": Distortion.named("nerfstudio", {"k1": -0.1, "k4": 0.05, "p2": 0.01}),
    "fov": Distortion.named("fov", {"omega": 0.8}),
    "division": Distortion.named("division", {"k": -0.2}),
    "pincushion by division": Distortion.named("division", {"k": 0.15}),
    "eucm": Distortion.named("eucm", {"alpha": 0.5, "beta": 1.2}),
    "fisheye624": Distortion.named("rad-tan-thin-prism-fisheye", {"k0": 0.05, "k5": 0.01, "p0": 0.01, "s3": -0.02}),
    "fisheye": Distortion.named("fisheye", {"k1": 0.05, "k2": -0.01, "k3": 0.002}),
    "prism of a fisheye": Distortion.named("thin-prism-fisheye", {"k1": 0.05, "p1": 0.01, "sx1": 0.02, "sy1": -0.01}),
}
SEEN_BY_PINHOLES = {name: value for name, value in LENSES.items() if not value.is_fisheye}
GRID = torch.cartesian_prod(*(torch.linspace(-e, e, 29, dtype=torch.float64) for e in (0.7, 0.5)))


def lens(distortion: Distortion) -> Intrinsics:
    return Intrinsics(110.0, 108.0, 78.0, 51.0, 160, 100, distortion)


def test_model_by_hand() -> None:
    # r2 = 0.25, so g = (1 + 0.1 / 4 + 0.2 / 16 + 0.3 / 64) / (1 + 0.4 / 4 + 0.5 / 16 + 0.6 / 64).
    d = opencv(k1=0.1, k2=0.2, p1=0.01, p2=0.02, k3=0.3, k4=0.4, k5=0.5, k6=0.6)
    g = (1 + 0.025 + 0.0125 + 0.0046875) / (1 + 0.1 + 0.03125 + 0.009375)
    expected = [0.3 * g + 0.02 * 0.12 + 0.02 * (0.25 + 0.18), 0.4 * g + 0.01 * (0.25 + 0.32) + 0.04 * 0.12]
    np.testing.assert_allclose(d.distort(torch.tensor([0.3, 0.4], dtype=torch.float64)), expected, rtol=1e-14)
    np.testing.assert_allclose(opencv(k1=0.1).distort(torch.tensor([0.0, 1.0])), [0, 1.1])
    assert Distortion().is_none and opencv(k2=0.0).is_none and not d.is_none and not Distortion("fisheye").is_none
    assert len(opencv(k1=0.1).coefficients) == 2 and len(d.coefficients) == 8


@pytest.mark.parametrize("distortion", LENSES.values(), ids=LENSES)
def test_inverse(distortion: Distortion) -> None:
    np.testing.assert_allclose(distortion.undistort(distortion.distort(GRID)), GRID, atol=1e-12)


@pytest.mark.parametrize("distortion", LENSES.values(), ids=LENSES)
def test_jacobian_is_the_derivative(distortion: Distortion) -> None:
    a, b, c, d = distortion.jacobian(GRID)
    step = 1e-6
    for axis, (x, y) in enumerate(((a, c), (b, d))):
        shift = step * torch.eye(2, dtype=torch.float64)[axis]
        difference = (distortion.distort(GRID + shift) - distortion.distort(GRID - shift)) / (2 * step)
        np.testing.assert_allclose(difference, torch.stack([x, y], dim=-1), atol=1e-8)


def test_points_beyond_a_fold_are_not_found() -> None:
    # x (1 - x^2) is at most 0.385; what 1.2 and -1.3 are mapped to is turned, and the lens with k2 rises again.
    seen = torch.tensor([[0.3, 0.0], [0.4, 0.0], [-0.528, 0.0], [0.897, 0.0]], dtype=torch.float64)
    inverse = opencv(k1=-1.0).undistort(seen)
    np.testing.assert_allclose(inverse[0], [0.3389, 0], atol=1e-4)
    assert torch.isnan(inverse[1:]).all()
    again = opencv(k1=-1.0, k2=0.23)
    beyond = torch.tensor([[2.0, 0.0]], dtype=torch.float64)
    assert again.keeps_orientation(beyond).all() and torch.isnan(again.undistort(again.distort(beyond))).all()
    with pytest.raises(CaptureError, match="folds the image"):
        pinhole_of(lens(opencv(k1=-1.0)), "this")


def test_pixels_that_a_kept_lens_cannot_have_made_are_known() -> None:
    assert known_pixels(lens(LENSES["fox"]), "this") is None and known_pixels(lens(Distortion()), "this") is None
    # 110 x 0.385 pixels around the principal point.
    folding = Intrinsics(150.0, 150.0, 80.0, 50.0, 160, 100, opencv(k1=-1.0))
    known = known_pixels(folding, "this")
    assert known is not None
    away = (folding.pixel_centers() - torch.tensor([80.0, 50.0])).norm(dim=-1)
    assert bool(known[away < 57.0].all()) and not bool(known[away > 58.0].any())
    with pytest.raises(CaptureError, match="folds the image"):
        known_pixels(lens(opencv(k1=-1.0)), "this")


def test_fisheyes_have_no_pinhole() -> None:
    with pytest.raises(CaptureError, match=r"fisheye, which no pinhole .*--keep-lens"):
        pinhole_of(lens(LENSES["fisheye"]), "this")


@pytest.mark.parametrize("distortion", SEEN_BY_PINHOLES.values(), ids=SEEN_BY_PINHOLES)
def test_pinhole_sees_all_it_can_but_nothing_beyond(distortion: Distortion) -> None:
    source = lens(distortion)
    pinhole = pinhole_of(source, "this")
    assert pinhole.distortion.is_none and (pinhole.width, pinhole.height) == (160, 100)
    pixels = torch.stack(torch.meshgrid(torch.arange(161.0), torch.arange(101.0), indexing="xy"), dim=-1).double()
    seen = source.to_pixels(distortion.distort(pinhole.to_normalised(pixels)))
    assert bool((seen > -0.01).all()) and bool((seen < torch.tensor([160.01, 100.01])).all())
    # Each edge touches the photograph's.
    assert seen[:, 0, 0].min() < 0.1 and seen[:, -1, 0].max() > 159.9
    assert seen[0, :, 1].min() < 0.1 and seen[-1, :, 1].max() > 99.9


def pattern(normalised: torch.Tensor) -> torch.Tensor:
    """(H, W, 3) smooth linear light as a function of undistorted coordinates."""
    x, y = normalised.unbind(-1)
    light = [0.5 + 0.4 * torch.sin(8 * x), 0.5 + 0.4 * torch.cos(9 * y), 0.5 + 0.4 * torch.sin(5 * (x + y))]
    return torch.stack(light, dim=-1).float()


@pytest.mark.parametrize("distortion", SEEN_BY_PINHOLES.values(), ids=SEEN_BY_PINHOLES)
def test_photographs_become_what_the_pinhole_sees(distortion: Distortion) -> None:
    source = lens(distortion)
    pinhole = pinhole_of(source, "this")
    photo = linear_to_srgb(pattern(distortion.undistort(source.to_normalised(source.pixel_centers()))))
    truth = linear_to_srgb(pattern(pinhole.to_normalised(pinhole.pixel_centers())))
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
