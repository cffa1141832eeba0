"""Captures whose images have several sizes: portrait and landscape, or several cameras."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from capture.photos.photo_checks import check_bounds, check_sentence, seen_at
from capture.photos.photo_scene import (
    CAMERA,
    COLOR,
    FOCAL,
    HEIGHT,
    WIDTH,
    dump,
    on_grey,
    opengl,
    orbit,
    picture,
    project,
    save,
    write_camera_list,
)

import difftetvr as dtv
from difftetvr.capture import (
    Capture,
    CaptureWarning,
    MixedImages,
    PackedImages,
    PhotoCapture,
    fibonacci_orbit,
    load_capture,
)
from difftetvr.errors import CaptureError
from difftetvr.fitting.refinement import Exchange

PORTRAIT = (30, 44)  # width and height


def cropped(values: np.ndarray) -> np.ndarray:
    """The upright part of a picture of 60 x 40 around its middle, with two rows of nothing above and below."""
    left = (WIDTH - PORTRAIT[0]) // 2
    return np.pad(values[:, left : left + PORTRAIT[0]], ((2, 2), (0, 0), (0, 0)), mode="edge")


def is_portrait(view: int) -> bool:
    return view % 3 == 0


def write_mixed(
    folder: Path, count: int = 16, opaque: bool = False, masks: bool = False, **of_portraits: float
) -> None:
    """A transforms.json with intrinsics in each frame."""
    frames = []
    for view, pose in enumerate(orbit(count)):
        values = picture(pose) if not opaque else on_grey(picture(pose))
        width, height = WIDTH, HEIGHT
        if is_portrait(view):
            values, (width, height) = cropped(values), PORTRAIT
        save(folder / "images" / f"{view:03}.png", values)
        own = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": width / 2, "cy": height / 2, "w": width, "h": height}
        own |= of_portraits if is_portrait(view) else {}
        frame = {"file_path": f"images/{view:03}.png", "transform_matrix": opengl(pose), **own}
        if masks:
            save(folder / "masks" / f"{view:03}.png", np.full((height, width), 255 * (np.arange(width) > 4), np.uint8))
            frame["mask_path"] = f"masks/{view:03}.png"
        frames.append(frame)
    dump(folder / "transforms.json", {"frames": frames})


def test_every_view_keeps_its_size(tmp_path: Path) -> None:
    write_mixed(tmp_path, masks=True)
    capture = load_capture(tmp_path)
    assert isinstance(capture.images, MixedImages) and isinstance(capture.alphas, MixedImages)
    assert capture.image_sizes == [PORTRAIT if is_portrait(view) else (WIDTH, HEIGHT) for view in range(16)]
    for view, pose in enumerate(orbit()):
        width, height = capture.image_sizes[view]
        image, alpha = capture.images[view], capture.alphas[view]
        assert image.shape == (height, width, 3) and image.dtype == torch.float32 and alpha.shape == (height, width)
        shift = ((width - WIDTH) / 2, (height - HEIGHT) / 2)
        np.testing.assert_allclose(seen_at(capture.cameras[view]), project(pose) + shift, atol=1e-3)
        ball = picture(pose)[..., 3:] > 0
        ball = torch.from_numpy((cropped(ball) if is_portrait(view) else ball)[..., 0])
        assert torch.equal(alpha > 0, ball)
        assert torch.allclose(image[ball], torch.tensor(COLOR / 255, dtype=torch.float32))
        assert torch.equal(capture.valid[view], (torch.arange(width) > 4).expand(height, width))
    check_bounds(capture)
    assert capture.silhouettes is not None and capture.is_cut_out
    assert [tuple(mask.shape) for mask in capture.silhouettes[:2]] == [(HEIGHT, WIDTH), (HEIGHT, WIDTH)]
    mean = torch.cat([image.flatten() for image in capture.images]).double().mean()
    assert float(capture.images.mean(dtype=torch.float64)) == pytest.approx(float(mean), rel=1e-6)


def test_downscaling_and_lenses_of_several_sizes(tmp_path: Path) -> None:
    write_mixed(tmp_path, opaque=True, k1=0.05, p1=0.01)
    assert PhotoCapture(str(tmp_path)).fitting_downscale(44) == 2  # 60 wide, not the 44 of the first image
    capture = load_capture(tmp_path, downscale=2)
    assert set(capture.image_sizes) == {(PORTRAIT[0] // 2, PORTRAIT[1] // 2), (WIDTH // 2, HEIGHT // 2)}
    assert capture.cameras[1].fx == FOCAL / 2 and capture.cameras[0].fx > FOCAL / 2
    assert capture.alphas is None and capture.silhouettes is None


def test_saved_captures_of_several_sizes(tmp_path: Path) -> None:
    write_mixed(tmp_path, masks=True)
    capture = load_capture(tmp_path)
    capture.save(tmp_path / "c.npz")
    again = load_capture(tmp_path / "c.npz")
    assert again.image_sizes == capture.image_sizes and again.test.tolist() == capture.test.tolist()
    for key in ("images", "alphas", "valid"):
        mine, its = getattr(capture, key), getattr(again, key)
        assert isinstance(its, MixedImages) and all(map(torch.equal, mine.data, its.data))
        assert [part.dtype for part in its.data] == [part.dtype for part in mine.data]
    with np.load(tmp_path / "c.npz") as archive:
        content = dict(archive)
    # What older versions read is still written as they read it.
    assert content["version"] == 4
    one_size = Capture(
        fibonacci_orbit(2, width=4, height=2),
        torch.zeros(2, 2, 4, 3),
        None,
        torch.tensor([True, False]),
        capture.bounds,
        "",
    )
    one_size.save(tmp_path / "one.npz")
    with np.load(tmp_path / "one.npz") as archive:
        assert archive["version"] == 3 and "sizes" not in archive
    for wrong in (content["sizes"][1:], content["sizes"] + 1, -content["sizes"], content["sizes"][0], np.array("none")):
        np.savez(tmp_path / "wrong.npz", **{**content, "sizes": wrong})
        with pytest.raises(CaptureError, match="wrong shape or type") as error:
            Capture.load(tmp_path / "wrong.npz")
        check_sentence(error.value)
    np.savez(tmp_path / "wrong.npz", **{**content, "alphas": content["alphas"][1:]})
    with pytest.raises(CaptureError, match="wrong shape or type"):
        Capture.load(tmp_path / "wrong.npz")


def test_images_that_do_not_fit_together(tmp_path: Path) -> None:
    write_mixed(tmp_path, masks=True)
    c = load_capture(tmp_path)
    negative = MixedImages(tuple(-view if i == 4 else view for i, view in enumerate(c.images)))
    fewer = MixedImages(c.alphas.data[1:])
    flipped = MixedImages(tuple(alpha.T for alpha in c.alphas.data))
    for images, alphas, valid, message in (
        (negative, None, None, "View 4 .* negative"),
        (c.images, fewer, None, "alphas .* do not fit its images in view 0"),
        (c.images, flipped, None, "alphas .* do not fit its images in view 0"),
        (c.images, torch.ones(16, HEIGHT, WIDTH), None, "alphas .* must be MixedImages"),
        (c.images, c.alphas, c.alphas, "valid pixels .* must be bools"),
        (MixedImages((torch.zeros(4, 5),) * 16), None, None, "shape"),
        (MixedImages((*c.images.data[1:], c.images.data[0])), None, None, "Camera 0 .* 30 x 44 pixels but"),
        (MixedImages(()), None, None, "shape"),
    ):
        with pytest.raises(CaptureError, match=message) as error:
            Capture(c.cameras, images, alphas, c.test, c.bounds, "x", valid=valid)
        check_sentence(error.value)


def test_a_fit_to_several_sizes(tmp_path: Path) -> None:
    write_mixed(tmp_path, masks=True)
    capture = load_capture(tmp_path)
    config = dtv.FitConfig(iterations=40, cells=300, refine="none", device="cpu", loss="l1-ssim")
    result = dtv.fit(capture, config, checkpoint=tmp_path / "run.safetensors")
    assert result.evaluation.mean_psnr > 15.0 and len(result.evaluation.ssim) == 2
    more = dtv.FitConfig(iterations=40, cells=300, refine="none", device="cpu", loss="l1-ssim")
    again = dtv.fit(capture, more, checkpoint=tmp_path / "run.safetensors", resume=True)
    assert torch.equal(again.mesh.vertices, result.mesh.vertices)
    swapped = MixedImages(tuple(torch.zeros_like(view) for view in capture.images.data))
    other = Capture(capture.cameras, swapped, capture.alphas, capture.test, capture.bounds, "x", encoding="srgb")
    with pytest.raises(dtv.FitError, match="mean_radiance"):
        dtv.fit(other, more, checkpoint=tmp_path / "run.safetensors", resume=True)


def test_a_refined_fit_and_its_pictures(tmp_path: Path) -> None:
    from difftetvr.fitting.records.folder import RunFolder
    from difftetvr.view.report import write_report

    write_mixed(tmp_path, count=9, opaque=True)
    capture = load_capture(tmp_path, bounds=(-0.5, -1.0, -0.7, 1.1, 0.6, 0.9))
    refined = Exchange(rounds=3, views=3)
    config = dtv.FitConfig(iterations=12, cells=400, harmonics=0, device="cpu", exchange=refined)
    result = dtv.fit(capture, config)
    assert len(result.history.refinements) == 3
    assert result.history.loss[-1] < result.history.loss[0]
    folder = RunFolder(tmp_path / "out")
    folder.path.mkdir()
    write_report(folder, result, capture)
    assert len(list(folder.views.iterdir())) == 4 and folder.comparison.stat().st_size > 0


def test_sizes_that_nearly_agree_are_cropped(tmp_path: Path) -> None:
    write_camera_list(tmp_path)
    poses = orbit()
    values = np.pad(picture(poses[3]), ((0, 1), (0, 2), (0, 0)))
    save(tmp_path / "003.png", values)
    with pytest.warns(CaptureWarning, match="1 are cropped .* to 60 x 40"):
        capture = load_capture(tmp_path)
    assert isinstance(capture.images, PackedImages) and capture.images.shape == (16, 40, 60, 3)
    for view, pose in enumerate(poses):
        np.testing.assert_allclose(seen_at(capture.cameras[view]), project(pose), atol=1e-3)
    save(tmp_path / "003.png", np.pad(values, ((0, 30), (0, 0), (0, 0))))
    assert load_capture(tmp_path).image_sizes[2:4] == [(60, 40), (62, 71)]


def test_info_says_the_sizes(tmp_path: Path) -> None:
    from rich.console import Console

    from difftetvr.view.describe import capture_table

    write_mixed(tmp_path, masks=True)
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(capture_table("mixed", load_capture(tmp_path)))
    text = console.export_text()
    assert "60 x 40 (10 views), 30 x 44 (6 views)" in text
    masked = 100 * (10 * 5 * 40 + 6 * 5 * 44) / (10 * 60 * 40 + 6 * 30 * 44)
    assert f"{masked:.1f} % of the pixels" in text


def test_16_bits_are_said_in_one_line(tmp_path: Path) -> None:
    cameras = []
    for view, pose in enumerate(orbit(4)):
        save(tmp_path / f"{view}.png", picture(pose)[..., 0].astype(np.uint16) * 257)
        cameras.append({"image": f"{view}.png", "world_to_camera": pose.tolist(), **CAMERA})
    dump(tmp_path / "cameras.json", {"format": "difftetvr-cameras", "cameras": cameras})
    with pytest.warns(CaptureWarning, match="4 of the images .* 16 bits a channel; 8 are kept") as said:
        capture = load_capture(tmp_path)
    assert len(said) == 1
    assert torch.equal(capture.images[1][..., 0] * 255, torch.from_numpy(picture(orbit(4)[1])[..., 0]).float())


def test_memory_is_asked_for_before_it_is_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_mixed(tmp_path)
    monkeypatch.setattr("difftetvr.trust.free_memory", lambda: 100_000)
    with pytest.raises(CaptureError, match=r"would take .* KiB, .* larger downscale") as error:
        load_capture(tmp_path)
    check_sentence(error.value)
    assert json.loads((tmp_path / "transforms.json").read_text())["frames"]
