"""NeRF-synthetic folders and tiny NeRF archives, made here and real."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from capture.damage import damaged_copies
from capture.photos.photo_checks import check_bounds, check_sentence, check_views
from capture.photos.photo_scene import (
    FOCAL,
    HEIGHT,
    WIDTH,
    dump,
    orbit,
    picture,
    save,
    write_nerf_synthetic,
    write_tiny,
)

from difftetvr import trusting
from difftetvr.capture import CaptureWarning, PackedImages, load_capture
from difftetvr.errors import CaptureError


def test_views_split_and_bounds(tmp_path: Path) -> None:
    poses = write_nerf_synthetic(tmp_path / "ball")
    capture = load_capture(tmp_path / "ball")
    check_views(capture, poses)
    check_bounds(capture)
    assert capture.test_indices.tolist() == [12, 13, 14, 15]
    assert (capture.name, capture.encoding) == ("ball", "srgb")
    assert isinstance(capture.images, PackedImages) and isinstance(capture.alphas, PackedImages)
    assert capture.cameras[0].fx == pytest.approx(FOCAL)
    np.testing.assert_array_equal(255 * capture.alphas[3].numpy(), picture(poses[3])[..., 3])


def test_absent_test_images_are_counted_and_left_out(tmp_path: Path) -> None:
    poses = write_nerf_synthetic(tmp_path, test_listed=9)
    with pytest.warns(CaptureWarning, match="5 of the 9 images .* missing"):
        capture = load_capture(tmp_path)
    check_views(capture, poses)


def test_absent_training_images_are_refused(tmp_path: Path) -> None:
    write_nerf_synthetic(tmp_path)
    (tmp_path / "train" / "r_3.png").unlink()
    with pytest.raises(CaptureError, match="r_3' is missing"):
        load_capture(tmp_path)


def test_validation_views_stand_in_for_absent_test_views(tmp_path: Path) -> None:
    poses = write_nerf_synthetic(tmp_path)
    (tmp_path / "transforms_test.json").rename(tmp_path / "transforms_val.json")
    check_views(load_capture(tmp_path), poses)
    (tmp_path / "transforms_val.json").unlink()
    capture = load_capture(tmp_path)
    assert capture.test_indices.tolist() == [0, 8] and len(capture.cameras) == 12


def test_colours_are_premultiplied_as_stored(tmp_path: Path) -> None:
    write_nerf_synthetic(tmp_path)
    values = picture(orbit()[0])
    values[..., :3], values[..., 3] = 200, 102
    save(tmp_path / "train" / "r_0.png", values)
    capture = load_capture(tmp_path)
    assert torch.allclose(capture.images[0], torch.tensor(80 / 255)) and torch.allclose(
        capture.alphas[0], torch.tensor(0.4)
    )


@pytest.mark.parametrize(
    ("break_it", "message"),
    [
        (lambda c: c["frames"][2]["transform_matrix"][1].__setitem__(3, float("nan")), "frame 2 .* not finite"),
        (lambda c: c["frames"][1]["transform_matrix"][0].__setitem__(0, 2.0), "frame 1 .* not rigid"),
        (lambda c: c["frames"][1]["transform_matrix"][0].__setitem__(0, 1e200), "frame 1 .* not rigid"),
        (lambda c: c["frames"][1].update(transform_matrix=[[1, 2], [3, 4]]), "frame 1 .* no 4 x 4 matrix"),
        (lambda c: c["frames"][1].update(transform_matrix="identity"), "frame 1 .* no 4 x 4 matrix"),
        (lambda c: c["frames"][0].pop("file_path"), "'file_path' of frame 0"),
        (lambda c: c.pop("camera_angle_x"), "no focal length"),
        (lambda c: c.update(camera_angle_x=4.0), "between 0 and pi"),
        (lambda c: c.update(camera_angle_x="wide"), "finite number"),
        (lambda c: c.update(frames=[]), "lists no 'frames'"),
        (lambda c: c["frames"].append(3), "lists no 'frames'"),
    ],
)
def test_wrong_descriptions(tmp_path: Path, break_it, message: str) -> None:
    write_nerf_synthetic(tmp_path)
    file = tmp_path / "transforms_train.json"
    content = json.loads(file.read_text())
    break_it(content)
    dump(file, content)
    with pytest.raises(CaptureError, match=message) as error:
        load_capture(tmp_path)
    check_sentence(error.value)


def test_damaged_descriptions_and_images_give_a_sentence(tmp_path: Path) -> None:
    write_nerf_synthetic(tmp_path)
    for path, least in ((tmp_path / "transforms_train.json", 15), (tmp_path / "train" / "r_0.png", 10)):
        original, failures = path.read_bytes(), 0
        for data in damaged_copies(original, seed=1, count=40):
            path.write_bytes(data)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                try:
                    load_capture(tmp_path)
                except CaptureError as error:
                    failures += 1
                    check_sentence(error)
        path.write_bytes(original)
        assert failures >= least


def test_silhouettes_that_do_not_meet(tmp_path: Path) -> None:
    write_nerf_synthetic(tmp_path)
    file = tmp_path / "transforms_train.json"
    content = json.loads(file.read_text())
    for frame in content["frames"]:
        # Cameras that look outwards: the axes of another convention.
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag([1.0, -1, -1, 1])).tolist()
    dump(file, content)
    with pytest.raises(CaptureError, match=r"do not meet|see nothing") as error:
        load_capture(tmp_path)
    check_sentence(error.value)


@pytest.mark.parametrize("channels", [3, 4])
def test_tiny_archives(tmp_path: Path, channels: int) -> None:
    poses = write_tiny(tmp_path / "ball.npz", channels)
    capture = load_capture(tmp_path / "ball.npz")
    check_views(capture, poses)
    # Black around the ball shows where it is, also without alpha.
    check_bounds(capture)
    assert capture.test_indices.tolist() == [0, 8] and (capture.alphas is None) == (channels == 3)
    half = load_capture(tmp_path / "ball.npz", downscale=2, test_every=0)
    assert half.images.shape == (16, HEIGHT // 2, WIDTH // 2, 3) and not half.test.any()
    whole = capture.images[1].reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean(dim=(1, 3))
    assert torch.allclose(half.images[1], whole, atol=1e-6)


def test_integers_of_tiny_archives(tmp_path: Path) -> None:
    poses = write_tiny(tmp_path / "ball.npz")
    with np.load(tmp_path / "ball.npz") as archive:
        content = dict(archive)
    for kind, most in (("u1", 255), ("<u2", 65535), (">u2", 65535)):
        np.savez(tmp_path / "ball.npz", **{**content, "images": (content["images"] * most).round().astype(kind)})
        check_views(load_capture(tmp_path / "ball.npz"), poses)
    np.savez(tmp_path / "ball.npz", **{**content, "images": content["images"].astype(np.int64)})
    with pytest.raises(CaptureError, match="are int64; store uint8") as error:
        load_capture(tmp_path / "ball.npz")
    check_sentence(error.value)


def test_tiny_archives_that_are_not(tmp_path: Path) -> None:
    """A few kB that become more than a GiB as floats."""
    arrays = {"images": np.zeros((1, 1, 300 * 2**20, 3), np.uint8)[:, :, :100_000_000], "poses": np.eye(4)[None]}
    np.savez_compressed(tmp_path / "a.npz", **arrays, focal=np.array(5.0))
    with pytest.raises(CaptureError, match=r"images as float32 .* 1 GiB; .*--allow-large") as error:
        load_capture(tmp_path / "a.npz")
    check_sentence(error.value)


def test_wrong_tiny_archives(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    for changes, message in (
        ({"images": np.zeros((2, 4, 4))}, "images of shape"),
        ({"poses": np.zeros((3, 4, 4))}, "poses of"),
        ({"poses": np.zeros((2, 4, 4))}, "not rigid"),
        ({"focal": np.array(0.0)}, "focal lengths"),
        ({"focal": np.array("f")}, "no numbers 'focal'"),
        ({"images": np.full((2, 4, 4, 3), np.nan)}, "negative or not finite|do not meet"),
    ):
        arrays = {"images": np.ones((2, 4, 4, 3)), "poses": np.stack([np.eye(4)] * 2), "focal": np.array(5.0)}
        np.savez(path, **{**arrays, **changes})
        with pytest.raises(CaptureError, match=message) as error:
            load_capture(path, bounds=(-1, -1, -2, 1, 1, -1))
        check_sentence(error.value)


def test_real_lego(shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "lego"
    if not folder.is_dir():
        pytest.skip("no lego")
    # A quarter of the training views, to be quick.
    for split in ("train", "test"):
        (tmp_path / split).symlink_to(folder.resolve() / split)
        content = json.loads((folder / f"transforms_{split}.json").read_text())
        content["frames"] = content["frames"][:: 4 if split == "train" else 1]
        dump(tmp_path / f"transforms_{split}.json", content)
    with trusting(outside=folder), pytest.warns(CaptureWarning, match="175 of the 200"):
        capture = load_capture(tmp_path, downscale=8)
    assert capture.images.shape == (50, 100, 100, 3) and capture.test.sum() == 25
    lower, upper = capture.bounds.numpy()
    # The model is about 1.3 x 2.3 x 1.6 long, wide and high.
    assert (lower > (-0.8, -1.3, -0.8)).all() and (lower < (-0.6, -1.1, -0.5)).all()
    assert (upper < (0.8, 1.35, 1.2)).all() and (upper > (0.6, 1.1, 0.9)).all()
    assert capture.alphas is not None and bool((capture.images[0] <= capture.alphas[0][..., None]).all())


def test_real_hotdog(shared_data: Path) -> None:
    file = shared_data / "hotdog-100px" / "hotdog.npz"
    if not file.is_file():
        pytest.skip("no hotdog")
    capture = load_capture(file)
    assert capture.images.shape == (100, 100, 100, 3) and capture.test.sum() == 13
    lower, upper = capture.bounds.numpy()
    assert (upper - lower < (2.7, 2.7, 1.1)).all() and (upper - lower > (2.2, 2.2, 0.4)).all()
