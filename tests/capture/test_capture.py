"""Captures: what they check, saving and loading, and every way to name one."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from capture.damage import damaged_copies

from difftetvr.capture import Capture, VolumeCapture, fibonacci_orbit, load_capture
from difftetvr.errors import CaptureError

SMALL = {"views": 10, "width": 12, "height": 8, "steps_per_unit": 200.0}


@pytest.fixture(scope="module")
def tooth() -> Capture:
    return load_capture("tooth", **SMALL)


def example(**changes) -> Capture:
    content = {
        "cameras": fibonacci_orbit(3, width=4, height=2),
        "images": torch.rand(3, 2, 4, 3, generator=torch.Generator().manual_seed(0)),
        "alphas": torch.ones(3, 2, 4),
        "test": torch.tensor([False, True, False]),
        "bounds": torch.tensor([[-1.0, -1, -1], [1, 1, 4]]),
        "name": "example",
        **changes,
    }
    return Capture(**content)


def test_tooth_is_the_standard_benchmark(tooth: Capture) -> None:
    defaults = VolumeCapture()
    assert (defaults.views, defaults.width, defaults.height, defaults.radius) == (80, 128, 128, 1.2)
    assert (defaults.attenuation, defaults.steps_per_unit) == (25.0, 2500.0)
    assert len(defaults.cameras()) == 80
    assert defaults.cameras()[0].fy == pytest.approx(128.0)
    assert tooth.test_indices.tolist() == [2, 7]
    assert tooth.train_indices.tolist() == [0, 1, 3, 4, 5, 6, 8, 9]
    assert tooth.density_unit == 25.0 and tooth.name == "tooth"
    np.testing.assert_allclose(tooth.bounds[1], [102 / 320, 93 / 320, 0.5])
    assert tooth.images.shape == (10, 8, 12, 3) and tooth.images.dtype == torch.float32
    assert tooth.alphas is not None and tooth.alphas.shape == (10, 8, 12)
    assert (tooth.images <= tooth.alphas[..., None] + 1e-5).all() and tooth.images.max() > 0.3


def test_crown_is_up_and_blue(tooth: Capture) -> None:
    capture = load_capture("tooth", views=9, width=48, height=48, steps_per_unit=300.0)
    image = capture.images[4]
    blueness = (image[..., 2] - image[..., 0]).clamp(min=0)
    rows = torch.arange(48.0)[:, None]
    center = (rows * blueness).sum() / blueness.sum()
    assert center < 20


def test_every_override_reaches_the_views(tooth: Capture) -> None:
    assert not load_capture("tooth", **SMALL, test_every=0).test.any()
    assert load_capture("tooth", **SMALL, test_every=3, test_offset=0).test_indices.tolist() == [0, 3, 6, 9]
    thin = load_capture("tooth", **SMALL, attenuation=1.0)
    assert thin.density_unit == 1.0 and thin.alphas is not None and tooth.alphas is not None
    assert thin.alphas.sum() < 0.5 * tooth.alphas.sum()
    first, second = (load_capture("tooth", **SMALL, orbit="random", seed=seed) for seed in (0, 1))
    assert not torch.equal(first.images, second.images)
    assert torch.equal(load_capture("tooth", **SMALL, shape=None).images, tooth.images)


def test_volume_files_need_a_transfer_function(tmp_path: Path) -> None:
    values = np.random.default_rng(0).integers(0, 256, (4, 5, 6)).astype(np.uint8)
    path, function = tmp_path / "blob_6x5x4_uint8.raw", tmp_path / "f.json"
    path.write_bytes(values.tobytes())
    function.write_text(json.dumps({"scalar": [0, 1], "opacity": [0, 1], "color": [[0, 0, 0], [1, 1, 1]]}))
    with pytest.raises(CaptureError, match="needs a transfer function"):
        load_capture(path)
    capture = load_capture(path, transfer_function=str(function), **SMALL)
    assert capture.name == "blob_6x5x4_uint8" and capture.images.max() > 0.5
    np.testing.assert_allclose(capture.bounds[1], [0.5, 0.4, 0.3])


@pytest.mark.parametrize("with_alpha", [True, False])
def test_round_trip_is_exact(tmp_path: Path, with_alpha: bool) -> None:
    capture = example(alphas=torch.rand(3, 2, 4) if with_alpha else None)
    capture.save(tmp_path / "c.npz")
    again = load_capture(tmp_path / "c.npz")
    for key in ("images", "test", "bounds"):
        assert torch.equal(getattr(again, key), getattr(capture, key))
    assert (again.alphas is None) == (capture.alphas is None)
    assert (again.name, again.density_unit) == ("example", 5.0)
    for mine, its in zip(capture.cameras, again.cameras):
        assert torch.equal(mine.world_to_camera, its.world_to_camera)
        for key in ("fx", "fy", "cx", "cy", "width", "height"):
            assert getattr(mine, key) == getattr(its, key)
    assert [p.name for p in tmp_path.iterdir()] == ["c.npz"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"images": torch.zeros(3, 2, 4)}, "shape"),
        ({"images": torch.zeros(2, 2, 4, 3)}, r"alphas .* shape"),
        ({"images": torch.zeros(2, 2, 4, 3), "alphas": None}, "2 images but 3 cameras"),
        ({"images": torch.full((3, 2, 4, 3), float("nan"))}, "View 0 .* colour"),
        (
            {"images": -torch.eye(3)[:, None, None, :].expand(3, 2, 4, 3) * torch.tensor([0, 1, 1.0])},
            "View 1 .* colour",
        ),
        ({"alphas": torch.tensor([0.0, 0.5, 1.5])[:, None, None].expand(3, 2, 4)}, "View 2 .* alpha"),
        ({"cameras": fibonacci_orbit(3, width=4, height=4)}, "Camera 0 .* 4 x 4 .* 4 x 2"),
        ({"test": torch.ones(3, dtype=torch.bool)}, "All views"),
        ({"test": torch.zeros(2, dtype=torch.bool)}, "test mask"),
        ({"bounds": torch.zeros(2, 3)}, "bounds"),
        ({"bounds": torch.tensor([[0.0, 0, 0], [1, 1, float("inf")]])}, "not finite"),
        ({"density_unit": -1.0}, "density unit"),
        ({"surroundings": 0.5}, "surroundings .* at least 1"),
        ({"surroundings": float("nan")}, "surroundings"),
    ],
)
def test_invalid_captures(changes: dict, message: str) -> None:
    with pytest.raises(CaptureError, match=message) as error:
        example(**changes)
    assert str(error.value).endswith(".") and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"views": 0}, "views is 0"),
        ({"width": 0}, "width is 0 pixels"),
        ({"radius": -1.0}, "radius"),
        ({"fov_y": 4.0}, "fov_y"),
        ({"attenuation": 0.0}, "attenuation"),
        ({"test_every": 1, "test_offset": 0}, "held out"),
        ({"test_offset": 5}, "held out"),
        ({"views": 1, "test_offset": 0}, "All views"),
        ({"orbit": "spiral"}, "orbit is 'spiral'"),
        ({"speed": 3}, "no setting 'speed'"),
        ({"shape": (1, 2, 3)}, "packaged tooth"),
    ],
)
def test_invalid_settings(changes: dict, message: str) -> None:
    with pytest.raises(CaptureError, match=message):
        load_capture("tooth", **{**SMALL, **changes})


def test_unknown_sources(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="is no capture: give 'tooth'"):
        load_capture("teeth")
    with pytest.raises(CaptureError, match="Cannot read"):
        load_capture(tmp_path / "none.npz")
    with pytest.raises(CaptureError, match=r"saved as \.npz"):
        example().save(tmp_path / "c.zip")
    with pytest.raises(CaptureError, match="create the folder"):
        example().save(tmp_path / "none" / "c.npz")
    example().save(tmp_path / "c.npz")
    with pytest.raises(CaptureError, match="leave out 'views'"):
        load_capture(tmp_path / "c.npz", views=3)
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(CaptureError, match="no array 'version'"):
        load_capture(tmp_path / "other.npz")


def test_damaged_captures_load_or_give_a_capture_error(tmp_path: Path) -> None:
    path, failures = tmp_path / "c.npz", 0
    example().save(path)
    for data in damaged_copies(path.read_bytes(), seed=6):
        path.write_bytes(data)
        try:
            Capture.load(path)
        except CaptureError as error:
            failures += 1
            assert "\n" not in str(error)
    assert failures > 75
