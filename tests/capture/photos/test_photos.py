"""What all photo captures share: our own cameras.json, image files, sizes, options, packing and saving."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from capture.photos.photo_checks import check_bounds, check_sentence, check_views, seen_at
from capture.photos.photo_scene import (
    FOCAL,
    HEIGHT,
    POINTS,
    WIDTH,
    dump,
    orbit,
    picture,
    project,
    save,
    write_camera_list,
    write_colmap,
    write_nerf_synthetic,
    write_transforms,
)
from PIL import Image

from difftetvr.capture import Capture, PackedImages, PhotoCapture, load_capture
from difftetvr.capture.photos.bounds import point_bounds
from difftetvr.errors import CaptureError
from difftetvr.fitting.records.evaluation import true_image
from difftetvr.rendering.cameras.pinhole import Camera


def test_camera_lists(tmp_path: Path) -> None:
    poses = write_camera_list(tmp_path)
    for source in (tmp_path, tmp_path / "cameras.json"):
        capture = load_capture(source)
        check_views(capture, poses)
        check_bounds(capture)
        assert capture.test_indices.tolist() == [0, 8]
    write_camera_list(tmp_path, bounds=[[-1, -2, -3], [1, 2, 3]])
    assert load_capture(tmp_path).bounds.tolist() == [[-1, -2, -3], [1, 2, 3]]


def test_camera_lists_may_say_what_is_held_out(tmp_path: Path) -> None:
    cameras = []
    for index, pose in enumerate(orbit(4)):
        save(tmp_path / f"{index}.png", picture(pose))
        intrinsics = {"fx": FOCAL, "fy": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2}
        cameras.append({"image": f"{index}.png", "world_to_camera": pose.tolist(), **intrinsics, "test": index == 2})
    dump(tmp_path / "cameras.json", {"format": "difftetvr-cameras", "cameras": cameras})
    assert load_capture(tmp_path).test_indices.tolist() == [2]
    for key, value, message in (
        ("fx", None, "lacks one of fx"),
        ("test", 1, "true or false"),
        ("image", "", "path of an image"),
        ("image", "none.png", "none.png' is missing"),
        ("world_to_camera", [[float("nan")] * 4] * 4, "camera 1 .* not finite"),
    ):
        wrong = [cameras[0], {**cameras[1], key: value}, *cameras[2:]]
        dump(tmp_path / "cameras.json", {"format": "difftetvr-cameras", "cameras": wrong})
        with pytest.raises(CaptureError, match=message) as error:
            load_capture(tmp_path)
        check_sentence(error.value)
    dump(tmp_path / "cameras.json", {"format": "difftetvr-cameras", "cameras": cameras, "bounds": [1, 2]})
    with pytest.raises(CaptureError, match="'bounds' of"):
        load_capture(tmp_path)


def test_points_too_far_to_square_are_outliers() -> None:
    points = np.concatenate([POINTS, [[1e200, 0.0, -1e300]]])
    cameras = [Camera(torch.from_numpy(pose), 50.0, 50.0, 30.0, 20.0, 60, 40) for pose in orbit()]
    with np.errstate(all="raise"):
        box = point_bounds(points, cameras)
    np.testing.assert_allclose(box, point_bounds(POINTS, cameras))


@pytest.mark.parametrize("factor", [2, 3, 7])
def test_downscaling_averages_blocks(tmp_path: Path, factor: int) -> None:
    poses = write_camera_list(tmp_path)
    whole, small = load_capture(tmp_path), load_capture(tmp_path, downscale=factor)
    height, width = HEIGHT // factor, WIDTH // factor
    assert small.images.shape == (16, height, width, 3)
    for view, pose in enumerate(poses):
        # Not of the image's size: 60 / 7 is no whole number, and the pixels at the right are lost.
        np.testing.assert_allclose(seen_at(small.cameras[view]), project(pose) / factor, atol=1e-3)
        image = whole.images[view][: height * factor, : width * factor]
        means = image.reshape(height, factor, width, factor, 3).mean(dim=(1, 3))
        assert float((small.images[view] - means).abs().max()) <= 0.501 / 255


def test_the_least_downscale_that_fits(tmp_path: Path) -> None:
    write_camera_list(tmp_path)  # 60 x 40
    chosen = [PhotoCapture(str(tmp_path)).fitting_downscale(pixels) for pixels in (100, 60, 59, 30, 29, 7)]
    assert chosen == [1, 1, 2, 2, 3, 9]
    write_nerf_synthetic(tmp_path / "nerf")
    assert PhotoCapture(str(tmp_path / "nerf")).fitting_downscale(30) == 2
    # Where only smaller copies are left, those count.
    write_colmap(tmp_path / "room")
    copies = tmp_path / "room" / "images_4"
    copies.mkdir()
    for file in sorted((tmp_path / "room" / "images").iterdir()):
        with Image.open(file) as image:
            image.resize((15, 10)).save(copies / file.name)
        file.unlink()
    chosen = [PhotoCapture(str(tmp_path / "room")).fitting_downscale(pixels) for pixels in (100, 15, 14)]
    assert chosen == [4, 4, 8]
    assert load_capture(tmp_path / "room", downscale=4).images.shape == (16, 10, 15, 3)
    with pytest.raises(CaptureError, match="holds no capture"):
        PhotoCapture(str(tmp_path / "nowhere")).fitting_downscale(100)


def test_formats_are_found_by_looking_and_can_be_forced(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    write_colmap(tmp_path)
    assert load_capture(tmp_path).points is None
    assert load_capture(tmp_path, format="colmap").points is not None
    write_nerf_synthetic(tmp_path)
    assert len(load_capture(tmp_path).cameras) == 16 and load_capture(tmp_path).test.sum() == 4
    assert load_capture(tmp_path, format="transforms").test.sum() == 2
    (tmp_path / "empty").mkdir()
    # Other programs write a cameras.json, too.
    dump(tmp_path / "empty" / "cameras.json", [1])
    for options, message in (
        ({}, "holds no capture that is known"),
        ({"format": "cameras"}, "no JSON object"),
        ({"format": "nerf-synthetic"}, "Cannot read"),
        ({"format": "transforms"}, "Cannot read"),
        ({"format": "colmap"}, "no sparse model"),
        ({"format": "tiny-nerf"}, "Cannot read"),
        ({"format": "video"}, "format is 'video'; it must be nerf-synthetic, "),
    ):
        with pytest.raises(CaptureError, match=message) as error:
            load_capture(tmp_path / "empty", **options)
        check_sentence(error.value)
    with pytest.raises(CaptureError, match="There is no"):
        load_capture(tmp_path / "none", format="colmap")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"downscale": 0}, "downscale is 0"),
        ({"downscale": 41}, "too few to shrink by 41"),
        ({"test_every": 1}, "test_every is 1"),
        ({"views": 3}, "photos has no setting 'views'; known are bounds, downscale"),
        ({"bounds": (0, 0, 0, 1, 1, 0)}, "upper corner"),
        ({"bounds": (50, 0, 0, 51, 1, 1)}, "14 cameras .* see nothing"),
    ],
)
def test_wrong_options(tmp_path: Path, options: dict, message: str) -> None:
    write_camera_list(tmp_path)
    with pytest.raises(CaptureError, match=message) as error:
        load_capture(tmp_path, **options)
    check_sentence(error.value)
    with pytest.raises(CaptureError, match="volume has no setting 'downscale'"):
        load_capture("tooth", downscale=2)


def test_packed_images_are_what_they_hold(tmp_path: Path) -> None:
    data = torch.randint(0, 256, (3, 4, 5, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    packed = PackedImages(data)
    floats = data.float() / 255
    assert packed.shape == floats.shape and len(packed) == 3 and packed.dtype == torch.float32
    assert torch.equal(packed[1], floats[1]) and torch.equal(packed[1:, 2, ::2], floats[1:, 2, ::2])
    assert float(packed.mean(dtype=torch.float64)) == pytest.approx(float(floats.double().mean()), rel=1e-6)


def test_photos_over_a_background(tmp_path: Path) -> None:
    write_camera_list(tmp_path)
    capture = load_capture(tmp_path)
    white = true_image(capture, 2, (1.0, 1.0, 1.0))
    values = picture(orbit()[2])
    expected = np.where(values[..., 3:] > 0, values[..., :3], 255) / np.float32(255)
    np.testing.assert_allclose(white, expected, atol=1e-6)


def test_saved_photos_are_read_back_to_the_bit(tmp_path: Path) -> None:
    write_colmap(tmp_path / "a")
    write_camera_list(tmp_path / "b")
    for folder in ("a", "b"):
        capture = load_capture(tmp_path / folder)
        if folder == "b":
            capture.valid = torch.rand(capture.images.shape[:3]) > 0.5
        capture.save(tmp_path / "c.npz")
        again = load_capture(tmp_path / "c.npz")
        assert isinstance(again.images, PackedImages) and torch.equal(again.images.data, capture.images.data)
        assert again.encoding == "srgb" and again.name == capture.name
        for key in ("alphas", "valid", "points", "point_colors", "bounds", "test"):
            mine, its = getattr(capture, key), getattr(again, key)
            assert (mine is None) == (its is None)
            assert mine is None or torch.equal(getattr(mine, "data", mine), getattr(its, "data", its))


def test_captures_of_the_first_version_are_read(tmp_path: Path) -> None:
    write_camera_list(tmp_path)
    capture = load_capture(tmp_path)
    capture.save(tmp_path / "c.npz")
    with np.load(tmp_path / "c.npz") as archive:
        content = dict(archive)
    old = {key: value for key, value in content.items() if key not in ("encoding", "surroundings")}
    old |= {
        "version": np.array(1),
        "images": content["images"] / np.float32(255),
        "alphas": content["alphas"] / np.float32(255),
    }
    np.savez(tmp_path / "old.npz", **old)
    again = Capture.load(tmp_path / "old.npz")
    assert (again.encoding, again.surroundings) == ("linear", 1.0) and again.points is None and again.valid is None
    assert isinstance(again.images, torch.Tensor) and torch.equal(again.images[3], capture.images[3])
    np.savez(tmp_path / "new.npz", **{**content, "version": np.array(6)})
    with pytest.raises(CaptureError, match="version 6; update"):
        Capture.load(tmp_path / "new.npz")
    for version in (np.inf, np.nan, "three", [1, 2], 1j):
        np.savez(tmp_path / "new.npz", **{**content, "version": np.array(version)})
        with pytest.raises(CaptureError, match="wrong shape or type"):
            Capture.load(tmp_path / "new.npz")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"encoding": "gamma"}, "encoding .* linear or srgb"),
        ({"valid": torch.ones(16, 2, 2, dtype=torch.bool)}, "valid pixels"),
        ({"points": torch.zeros(3)}, "points .* finite numbers"),
        ({"points": torch.full((1, 3), float("nan"))}, "points .* finite numbers"),
        ({"point_colors": torch.zeros(3, 3)}, "a point for each"),
    ],
)
def test_invalid_fields(tmp_path: Path, changes: dict, message: str) -> None:
    write_camera_list(tmp_path)
    c = load_capture(tmp_path)
    with pytest.raises(CaptureError, match=message) as error:
        Capture(c.cameras, c.images, c.alphas, c.test, c.bounds, "x", **changes)
    check_sentence(error.value)
