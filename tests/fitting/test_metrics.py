"""PSNR and SSIM against independent implementations."""

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from difftetvr.errors import CaptureError
from difftetvr.fitting.losses import LOSSES, l1, l2
from difftetvr.fitting.metrics import psnr, ssim


def images(height=31, width=26, seed=0):
    random = np.random.default_rng(seed)
    reference = gaussian_filter(random.random((height, width, 3)), (2, 2, 0))
    image = reference + 0.05 * random.standard_normal(reference.shape)
    return torch.tensor(image, dtype=torch.float32), torch.tensor(reference, dtype=torch.float32)


def ssim_by_scipy(image, reference):
    """SSIM by Gaussian filters of scipy, whose border of half a window is cut off."""
    values = []
    for channel in range(3):
        a, b = (x[..., channel].double().clamp(0, 1).numpy() for x in (image, reference))

        def blur(x):
            return gaussian_filter(x, 1.5, radius=5)[5:-5, 5:-5]

        mean_a, mean_b = blur(a), blur(b)
        variance_a, variance_b = blur(a * a) - mean_a**2, blur(b * b) - mean_b**2
        covariance = blur(a * b) - mean_a * mean_b
        c1, c2 = 0.01**2, 0.03**2
        numerator = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
        values.append(numerator / ((mean_a**2 + mean_b**2 + c1) * (variance_a + variance_b + c2)))
    return float(np.mean(values))


@pytest.mark.parametrize("size", [(31, 26), (11, 11), (11, 40)])
def test_ssim_agrees_with_scipy(size):
    image, reference = images(*size)
    assert ssim(image, reference) == pytest.approx(ssim_by_scipy(image, reference), abs=1e-12)


def test_ssim_of_equal_and_of_opposite_images():
    _, reference = images()
    assert ssim(reference, reference) == pytest.approx(1.0)
    assert ssim(1.0 - reference, reference) < 0.5


def test_psnr_of_a_known_error():
    reference = torch.full((4, 5, 3), 0.5)
    assert psnr(reference + 0.1, reference) == pytest.approx(20.0, abs=1e-5)


def test_psnr_clips_to_the_data_range():
    assert psnr(torch.full((2, 2, 3), 7.0), torch.ones(2, 2, 3)) == 160.0
    assert psnr(torch.full((2, 2, 3), -3.0), torch.full((2, 2, 3), 0.1)) == pytest.approx(20.0, abs=1e-5)


def test_psnr_of_equal_images_is_finite():
    image, _ = images()
    assert math.isfinite(psnr(image, image))


@pytest.mark.parametrize("metric", [psnr, ssim])
def test_different_shapes_are_refused(metric):
    with pytest.raises(CaptureError, match="shape"):
        metric(torch.zeros(12, 12, 3), torch.zeros(12, 13, 3))


def test_ssim_refuses_images_smaller_than_its_window():
    with pytest.raises(CaptureError, match="at least 11 x 11"):
        ssim(torch.zeros(10, 20, 3), torch.zeros(10, 20, 3))


def test_losses():
    image, reference = torch.tensor([[[0.0, 1.0, 4.0]]]), torch.tensor([[[1.0, 1.0, 1.0]]])
    assert l1(image, reference).item() == pytest.approx(4 / 3)
    assert l2(image, reference).item() == pytest.approx(10 / 3)


def test_the_ssim_of_a_loss_is_not_rounded_under_autocast():
    image, reference = images()
    expected = LOSSES["l1-ssim"](image, reference)
    with torch.autocast("cpu"):
        assert torch.allclose(LOSSES["l1-ssim"](image, reference), expected, rtol=1e-6)
