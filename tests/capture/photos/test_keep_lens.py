"""Photographs that are left as their lens has distorted them: what becomes of them, their masks and their cameras."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from capture.photos.photo_checks import check_bounds, check_sentence
from capture.photos.photo_scene import (
    CENTER,
    COLOR,
    FOCAL,
    HEIGHT,
    POINTS,
    RADIUS,
    WIDTH,
    dump,
    opengl,
    orbit,
    save,
    write_camera_list,
    write_transforms,
)

from difftetvr.capture import Capture, CaptureWarning, PhotoCapture, VolumeRenderer, load_capture
from difftetvr.capture.free_space import FreeSpace
from difftetvr.capture.viewing import in_image
from difftetvr.errors import CaptureError
from difftetvr.rendering import Camera, LensCamera

BARREL = {"k1": -0.35, "k2": 0.1, "p1": 0.01, "p2": -0.02, "k3": 0.0}
FISHEYE = {"camera_model": "OPENCV_FISHEYE", "k1": 0.05, "k2": -0.01, "k3": 0.0, "k4": 0.0}


def camera_of(pose: np.ndarray, model: str, coefficients: list[float]) -> LensCamera:
    numbers = (torch.from_numpy(pose), FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
    return LensCamera(*numbers, model=model, coefficients=torch.tensor(coefficients, dtype=torch.float64))


def ball_seen_by(camera: LensCamera) -> np.ndarray:
    """(H, W, 4) uint8 image of the ball through a lens, transparent around it."""
    center = camera.to_camera_space(torch.from_numpy(CENTER)[None])
    directions = camera.ray_directions()
    hit = torch.linalg.cross(directions, center.expand_as(directions)).norm(dim=-1) < RADIUS
    return np.concatenate([np.where(hit[..., None], COLOR, 0), 255 * hit[..., None]], axis=-1).astype(np.uint8)


def write_distorted(folder: Path, lens: dict[str, object], **top: object) -> list[LensCamera]:
    """16 views of the ball through a lens in a transforms.json; returns the cameras."""
    model = "fisheye" if "camera_model" in lens else "opencv"
    coefficients = [value for key, value in lens.items() if key != "camera_model"]
    cameras = [camera_of(pose, model, coefficients) for pose in orbit()]
    frames = []
    for index, (pose, camera) in enumerate(zip(orbit(), cameras, strict=True)):
        save(folder / "images" / f"{index:03}.png", ball_seen_by(camera))
        frames.append({"file_path": f"images/{index:03}.png", "transform_matrix": opengl(pose)})
    intrinsics = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT}
    dump(folder / "transforms.json", {**intrinsics, **lens, **top, "frames": frames})
    return cameras


@pytest.mark.parametrize("lens", [BARREL, FISHEYE], ids=["barrel", "fisheye"])
def test_images_stay_and_cameras_have_the_lens(tmp_path: Path, lens: dict[str, object]) -> None:
    expected = write_distorted(tmp_path, lens)
    capture = load_capture(tmp_path, keep_lens=True)
    assert capture.valid is None and capture.image_sizes == [(WIDTH, HEIGHT)] * 16
    for view, (mine, its) in enumerate(zip(capture.cameras, expected, strict=True)):
        assert isinstance(mine, LensCamera) and mine.model == its.model
        assert torch.equal(mine.coefficients, its.coefficients)
        assert (mine.fx, mine.cx, mine.width) == (its.fx, its.cx, its.width)
        torch.testing.assert_close(mine.world_to_camera, its.world_to_camera.float())
        pixels = torch.cat([capture.images[view], capture.alphas[view][..., None]], dim=-1)
        assert torch.equal((255.0 * pixels).round().byte(), torch.from_numpy(ball_seen_by(its)))
    check_bounds(capture)
    assert PhotoCapture(str(tmp_path), keep_lens=True).build().bounds.equal(capture.bounds)


def test_what_is_kept_agrees_with_what_is_undistorted(tmp_path: Path) -> None:
    """Points are seen in the kept images where the undistorted ones show them, by either's camera."""
    write_distorted(tmp_path, BARREL)
    kept, resampled = load_capture(tmp_path, keep_lens=True), load_capture(tmp_path)
    assert all(type(camera) is Camera for camera in resampled.cameras)
    inside = torch.from_numpy(CENTER + 0.8 * (POINTS - CENTER))
    for view in range(16):
        for capture in (kept, resampled):
            pixels, enlarged = capture.cameras[view].project(inside)
            assert in_image(pixels, enlarged, capture.cameras[view]).all()
            columns, rows = pixels.long().T
            assert (capture.alphas[view][rows, columns] > 0.99).all()
    torch.testing.assert_close(kept.bounds, resampled.bounds, atol=0.07, rtol=0.0)  # a cell of the hull


def test_pinholes_stay_pinholes(tmp_path: Path) -> None:
    write_camera_list(tmp_path)
    kept, plain = load_capture(tmp_path, keep_lens=True), load_capture(tmp_path)
    assert all(type(camera) is Camera for camera in kept.cameras)
    assert torch.equal(kept.images.data, plain.images.data) and torch.equal(kept.bounds, plain.bounds)


def test_downscaling_scales_the_pinhole_and_not_the_lens(tmp_path: Path) -> None:
    write_distorted(tmp_path, BARREL)
    whole, half = (load_capture(tmp_path, keep_lens=True, downscale=factor) for factor in (1, 2))
    assert half.image_sizes[0] == (WIDTH // 2, HEIGHT // 2)
    for one, other in zip(whole.cameras, half.cameras, strict=True):
        assert torch.equal(one.coefficients, other.coefficients)
        assert (other.fx, other.cx, other.cy) == (FOCAL / 2, WIDTH / 4, HEIGHT / 4)
        points = torch.from_numpy(POINTS)
        torch.testing.assert_close(one.project(points)[0], 2.0 * other.project(points)[0])
    means = whole.images[3].reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean(dim=(1, 3))
    assert float((half.images[3] - means).abs().max()) < 1.1 / 255


def test_masks_and_lenses_of_single_frames(tmp_path: Path) -> None:
    write_distorted(tmp_path, BARREL)
    content = json.loads((tmp_path / "transforms.json").read_text())
    save(tmp_path / "mask.png", np.full((HEIGHT, WIDTH), 255 * (np.arange(WIDTH) > 4), np.uint8))
    content["frames"][2] |= {"mask_path": "mask.png", **dict.fromkeys(BARREL, 0.0)}
    dump(tmp_path / "transforms.json", content)
    capture = load_capture(tmp_path, keep_lens=True)
    assert type(capture.cameras[2]) is Camera and isinstance(capture.cameras[3], LensCamera)
    assert torch.equal(capture.valid[2], (torch.arange(WIDTH) > 4).expand(HEIGHT, WIDTH))
    assert capture.valid[3].all()


def test_pixels_that_the_lens_cannot_have_made_are_masked(tmp_path: Path) -> None:
    """The formula of this lens has its fold 28 pixels from the middle."""
    cameras = write_distorted(tmp_path, {"k1": -0.47, "k2": 0.0})
    with pytest.warns(CaptureWarning, match=r"16 of the images .* cannot have made, .* masked") as said:
        capture = load_capture(tmp_path, keep_lens=True)
    assert len(said) == 1
    known = torch.isfinite(cameras[0].ray_directions()).all(-1)
    assert 0.5 < float(known.float().mean()) < 0.95
    assert all(torch.equal(valid, known) for valid in capture.valid)
    check_bounds(capture)
    write_distorted(tmp_path, {"k1": -3.0, "k2": 0.0})
    with pytest.raises(CaptureError, match="folds the image") as error:
        load_capture(tmp_path, keep_lens=True)
    check_sentence(error.value)


def test_lenses_that_nerfstudio_lists(tmp_path: Path) -> None:
    write_distorted(tmp_path, {"k1": 0.5, "k2": 0.0})
    content = json.loads((tmp_path / "transforms.json").read_text())
    content |= {"distortion_params": [-0.1, 0.02, 0.0, 0.03, 0.01, 0.0]}
    aria = [0.01 * count for count in range(12)]
    content["frames"][1] |= {"camera_model": "FISHEYE624", "distortion_params": aria}
    content["frames"][2] |= {"distortion_params": [-0.1, 0.0, 0.0, 0.0, 0.02, 0.0]}
    content["frames"][3] |= {"is_fisheye": True, "distortion_params": [-0.1, 0.02, 0.0, 0.01, 0.0, 0.0]}
    content["frames"][4] |= {"distortion_params": None, "k4": 0.02}
    content["frames"][5] |= {"k1": 0.25}  # its own, not the list of all
    content["frames"][6] |= {"is_fisheye": True, "camera_model": "FISHEYE624", "distortion_params": aria}
    dump(tmp_path / "transforms.json", content)
    capture = load_capture(tmp_path, keep_lens=True)
    capture.save(tmp_path / "c.npz")
    for cameras in (capture.cameras, load_capture(tmp_path / "c.npz").cameras):
        lenses = [(camera.model, camera.coefficients.tolist()) for camera in cameras[:7]]  # type: ignore[attr-defined]
        assert lenses == [
            ("nerfstudio", [-0.1, 0.02, 0.0, 0.03, 0.01, 0.0]),
            ("rad-tan-thin-prism-fisheye", aria),
            ("opencv", [-0.1, 0.0, 0.02, 0.0, 0.0]),
            ("fisheye", [-0.1, 0.02, 0.0, 0.01]),
            ("nerfstudio", [0.5, 0.0, 0.0, 0.02, 0.0, 0.0]),
            ("opencv", [0.25, 0.0, 0.0, 0.0, 0.0]),
            ("rad-tan-thin-prism-fisheye", aria),
        ]


@pytest.mark.parametrize("mixed", [False, True])
def test_saved_captures_keep_the_lens(tmp_path: Path, mixed: bool) -> None:
    write_distorted(tmp_path, BARREL)
    content = json.loads((tmp_path / "transforms.json").read_text())
    content["frames"][1] |= {"camera_model": "OPENCV_FISHEYE", "p1": 0.0, "p2": 0.0}
    content["frames"][2] |= dict.fromkeys(BARREL, 0.0)
    if mixed:
        save(tmp_path / "images" / "005.png", np.zeros((30, 30, 4), np.uint8))
        content["frames"][5] |= {"w": 30, "h": 30, "cx": 15.0}
    dump(tmp_path / "transforms.json", content)
    capture = load_capture(tmp_path, keep_lens=True)
    capture.save(tmp_path / "c.npz")
    again = load_capture(tmp_path / "c.npz")
    kinds = [camera.model if isinstance(camera, LensCamera) else None for camera in again.cameras]
    assert kinds == ["opencv", "fisheye", None, *["opencv"] * 13]
    for mine, its in zip(capture.cameras, again.cameras, strict=True):
        for item in dataclasses.fields(mine):
            one, other = (getattr(camera, item.name) for camera in (mine, its))
            assert torch.equal(one, other) if isinstance(one, torch.Tensor) else one == other
    with pytest.raises(CaptureError, match="read as it is; leave out 'keep_lens'"):
        load_capture(tmp_path / "c.npz", keep_lens=True)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.pop("lens_models"), "wrong shape or type"),
        (lambda c: c.pop("lens_coefficients"), "wrong shape or type"),
        (lambda c: c.update(lens_models=c["lens_models"][1:]), "wrong shape or type"),
        (lambda c: c.update(lens_coefficients=c["lens_coefficients"][:, 0]), "wrong shape or type"),
        (lambda c: c.update(lens_coefficients=np.array("none")), "wrong shape or type"),
        (lambda c: c["lens_coefficients"].__setitem__((3, 1), np.nan), "wrong shape or type"),
        (lambda c: c["lens_coefficients"].__setitem__((3, 4), np.nan), None),
        (lambda c: c["lens_coefficients"].__setitem__((3, 1), np.inf), "camera .* not finite"),
        (lambda c: c["lens_coefficients"].__setitem__((3, slice(1, None)), np.nan), "has 1 coefficients"),
        (lambda c: c["lens_models"].__setitem__(3, "fish"), "no lens model 'fish'"),
        (lambda c: c.update(version=np.array(6)), "version 6; update"),
    ],
)
def test_damaged_lenses(tmp_path: Path, change: Callable[[dict[str, np.ndarray]], None], message: str | None) -> None:
    write_distorted(tmp_path, BARREL)
    load_capture(tmp_path, keep_lens=True).save(tmp_path / "c.npz")
    with np.load(tmp_path / "c.npz") as archive:
        content = dict(archive)
    assert content["version"] == 5
    change(content)
    np.savez(tmp_path / "c.npz", **content)
    if message is None:
        assert len(Capture.load(tmp_path / "c.npz").cameras[3].coefficients) == 4
        return
    with pytest.raises(CaptureError, match=message) as error:
        Capture.load(tmp_path / "c.npz")
    check_sentence(error.value)


def test_free_space_ends_beside_what_the_lens_sees(tmp_path: Path) -> None:
    """In a cone wider than the view by half its longer side, of the directions in which the lens sees that."""
    cameras = write_distorted(tmp_path, BARREL)
    capture = load_capture(tmp_path, keep_lens=True, bounds=(-0.5, -1.0, -0.7, 1.1, 0.6, 0.9))
    space = capture.free_space(0.8)
    assert len(space.cameras) == len(capture.train_indices)
    # On the axis, on the rays of the corners, and beside the camera, all as far off.
    camera, reach = space.cameras[0], space.reaches[0]
    axis = camera.world_to_camera[2, :3]
    corners = cameras[0].ray_directions()[:: HEIGHT - 1, :: WIDTH - 1].reshape(-1, 3).float()
    ways = torch.cat([axis[None], corners @ camera.world_to_camera[:3, :3], camera.world_to_camera[:2, :3]])
    assert space.contains(camera.position + 0.9 * reach * ways).tolist() == [True] * 5 + [False] * 2
    alone = FreeSpace([camera], [reach])
    assert not alone.contains(camera.position + 1.1 * reach * axis[None]).any()


def test_masked_pixels_say_nothing_about_silhouettes() -> None:
    from difftetvr.capture.hull import silhouettes

    images, valid = torch.zeros(1, 20, 20, 3), torch.zeros(1, 20, 20, dtype=torch.bool)
    images[:, 8:12, 8:12] = 0.5
    # A rim of nothing, as around the circle of a fisheye.
    valid[:, 3:-3, 3:-3] = True
    assert silhouettes(images, None, [0], valid) is None
    valid[:, :, 3:-3] = True
    (mask,) = silhouettes(images, None, [0], valid)
    assert torch.equal(mask, (images[0] > 0).any(-1) | ~valid[0])


def test_what_has_no_lens_refuses_the_option(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="volume has no setting 'keep_lens'"):
        load_capture("tooth", keep_lens=True)
    write_transforms(tmp_path)
    with pytest.raises(CaptureError, match=r"The keep_lens is 'yes'; it must be True or False\."):
        load_capture(tmp_path, keep_lens="yes")


def test_volumes_are_seen_by_pinholes_alone() -> None:
    from difftetvr.capture import Volume
    from difftetvr.optics import TransferFunction

    renderer = VolumeRenderer(Volume(np.ones((3, 4, 5), np.float32)), TransferFunction.default(), 1.0, device="cpu")
    with pytest.raises(CaptureError, match="pinhole cameras alone"):
        renderer.render([camera_of(orbit()[0], "opencv", [0.1, 0.0])])
