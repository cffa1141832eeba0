"""What files of captures name: images and masks inside their folder, and numbers that are none."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from capture.photos.photo_checks import check_sentence, check_views
from capture.photos.photo_scene import (
    HEIGHT,
    WIDTH,
    dump,
    orbit,
    picture,
    save,
    write_camera_list,
    write_colmap,
    write_nerf_synthetic,
    write_transforms,
)

from difftetvr import trusting
from difftetvr.capture import load_capture
from difftetvr.errors import CaptureError

OUTSIDE = "which lies outside of its folder; .*--allow-outside"


def edit(file: Path, change: Callable[[dict], object]) -> None:
    content = json.loads(file.read_text())
    change(content)
    dump(file, content)


def refused(folder: Path, message: str = OUTSIDE) -> None:
    with pytest.raises(CaptureError, match=message) as error:
        load_capture(folder)
    check_sentence(error.value)


@pytest.mark.parametrize("downscale", [1, 2])
@pytest.mark.parametrize("write", [write_camera_list, write_transforms, write_colmap, write_nerf_synthetic])
def test_captures_in_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, write: Callable, downscale: int
) -> None:
    write(tmp_path / "ball")
    monkeypatch.chdir(tmp_path / "ball")
    for source in (".", *(name for name in ("cameras.json", "transforms.json") if os.path.exists(name))):
        capture = load_capture(source, downscale=downscale)
        assert capture.image_sizes == [(WIDTH // downscale, HEIGHT // downscale)] * 16 and capture.name == "ball"


def test_images_beside_their_file_have_no_smaller_copies(tmp_path: Path) -> None:
    """Those would lie outside of the capture."""
    write_camera_list(tmp_path / "ball")
    for index in range(16):
        save(tmp_path / "ball_2" / f"{index:03}.png", np.zeros((HEIGHT // 2, WIDTH // 2, 3), dtype=np.uint8))
    assert float(load_capture(tmp_path / "ball", downscale=2).images.mean()) > 0


def test_absolute_paths(tmp_path: Path) -> None:
    poses = write_transforms(tmp_path / "ball")
    for index in range(16):
        save(tmp_path / "ball" / "images_2" / f"{index:03}.png", np.full((HEIGHT // 2, WIDTH // 2, 3), 77, np.uint8))
    (tmp_path / "link").symlink_to(tmp_path / "ball")
    for folder in ("ball", "link"):

        def make_absolute(content: dict, folder: str = folder) -> None:
            for frame in content["frames"]:
                frame["file_path"] = str(tmp_path / folder / "images" / Path(frame["file_path"]).name)

        edit(tmp_path / "ball" / "transforms.json", make_absolute)
        check_views(load_capture(tmp_path / "ball"), poses)
        copies = load_capture(tmp_path / "ball", downscale=2, bounds=(-1, -1, -1, 1, 1, 1))
        assert (copies.images.data == 77).all()
    (tmp_path / "ball" / "transforms.json").rename(tmp_path / "link" / ".." / "transforms.json")
    check_views(load_capture(tmp_path / "transforms.json"), poses)


def test_names_that_lead_outside(tmp_path: Path) -> None:
    save(tmp_path / "private.png", picture(orbit()[3]))
    for write, file, key in (
        (write_transforms, "transforms.json", "file_path"),
        (write_camera_list, "cameras.json", "image"),
    ):
        folder = tmp_path / key
        write(folder)
        for name in ("../private.png", "./../private.png", str(tmp_path / "private.png"), "..\\private.png"):
            edit(
                folder / file,
                lambda c, name=name, key=key: next(v for v in c.values() if _lists(v))[0].update({key: name}),
            )
            refused(folder)
            with trusting(outside=tmp_path):
                assert len(load_capture(folder).cameras) == 16
    folder = tmp_path / "masked"
    write_transforms(folder)
    edit(folder / "transforms.json", lambda c: c["frames"][3].update(mask_path="../private.png"))
    refused(folder)
    edit(
        folder / "transforms.json",
        lambda c: c["frames"][3].update(mask_path=None) or c.update(ply_file_path="../a.ply"),
    )
    refused(folder)


def _lists(value: object) -> bool:
    return isinstance(value, list) and isinstance(value[0], dict)


def test_links_that_lead_outside(tmp_path: Path) -> None:
    """Those of suffixes that are left out, of smaller copies, of folders, and of COLMAP's names and masks, too."""
    save(tmp_path / "private.png", picture(orbit()[3]))
    write_nerf_synthetic(tmp_path / "nerf")
    (tmp_path / "nerf" / "train" / "r_3.png").unlink()
    (tmp_path / "nerf" / "train" / "r_3.png").symlink_to(tmp_path / "private.png")
    refused(tmp_path / "nerf")
    write_colmap(tmp_path / "colmap", ".txt")
    (tmp_path / "colmap" / "masks").mkdir()
    (tmp_path / "colmap" / "masks" / "004.png.png").symlink_to(tmp_path / "private.png")
    refused(tmp_path / "colmap")
    (tmp_path / "colmap" / "masks" / "004.png.png").unlink()
    (tmp_path / "colmap" / "masks").rmdir()
    images = tmp_path / "colmap" / "sparse" / "0" / "images.txt"
    images.write_text(images.read_text().replace("004.png", "../../private.png"))
    refused(tmp_path / "colmap")
    write_transforms(tmp_path / "copies")
    (tmp_path / "elsewhere").mkdir()
    save(tmp_path / "elsewhere" / "005.png", picture(orbit()[5])[::2, ::2])
    (tmp_path / "copies" / "images_2").symlink_to(tmp_path / "elsewhere")
    assert len(load_capture(tmp_path / "copies").cameras) == 16
    with pytest.raises(CaptureError, match=OUTSIDE):
        load_capture(tmp_path / "copies", downscale=2)


@pytest.mark.parametrize(
    "name", ["/", ".", "./", "//", "a" * 5000, "\ud800.png", "images", "..", "images/..", "nul\0.png"]
)
def test_names_that_are_none(tmp_path: Path, name: str) -> None:
    write_camera_list(tmp_path)
    edit(tmp_path / "cameras.json", lambda c: c["cameras"][2].update(image=name))
    refused(tmp_path, r"give the path of|missing|no path|lies outside")


HUGE = 10**400


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.update(fl_x=HUGE), "'fl_x' .* finite number"),
        (lambda c: c.update(fl_x=-HUGE), "'fl_x' .* finite number"),
        (lambda c: c.update(fl_x=1e308, fl_y=1e-308), "no more than a lens has"),
        (lambda c: c.update(w=HUGE), "finite number"),
        (lambda c: c.update(w=1e300), "at most 1,048,576"),
        (lambda c: c.update(aabb_scale=4, offset=[HUGE, 0, 0]), "offset"),
        (lambda c: c.update(aabb_scale=HUGE), "aabb_scale"),
        (lambda c: c.update(k1=HUGE), "finite number"),
        (lambda c: c["frames"][0].update(transform_matrix=[[HUGE] * 4] * 4), "no 4 x 4 matrix"),
        (lambda c: c["frames"][0]["transform_matrix"][0].__setitem__(3, 1e300), "not valid|too far|see nothing|finite"),
        (lambda c: c["frames"][0].update(file_path=["a"] * 10_000), r"'file_path' of frame 0 .* is \['a', .*\.\.\."),
        (lambda c: c["frames"][0].update(file_path={"a": HUGE}), "'file_path' of frame 0"),
    ],
)
def test_numbers_that_are_too_large(tmp_path: Path, change: Callable[[dict], object], message: str) -> None:
    write_transforms(tmp_path)
    edit(tmp_path / "transforms.json", change)
    with pytest.raises(CaptureError, match=f"(?i){message}") as error:
        load_capture(tmp_path)
    check_sentence(error.value)
    assert len(str(error.value)) < 600


def test_bounds_that_are_too_large(tmp_path: Path) -> None:
    for bounds, message in (
        ([[-HUGE, 0, 0], [1, 1, 1]], "'bounds' of"),
        ([[-1e300, 0, 0], [1, 1, 1]], "bounds .* not finite"),
    ):
        write_camera_list(tmp_path, bounds=bounds)
        refused(tmp_path, message)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes")
def test_pipes_are_no_files(tmp_path: Path) -> None:
    write_transforms(tmp_path / "a")
    os.mkfifo(tmp_path / "a" / "mask.png")
    edit(tmp_path / "a" / "transforms.json", lambda c: c["frames"][3].update(mask_path="mask.png"))
    refused(tmp_path / "a", "mask.png: it is a pipe or a device")
    edit(tmp_path / "a" / "transforms.json", lambda c: c["frames"][3].update(mask_path=None, file_path="mask.png"))
    with pytest.warns(UserWarning, match="1 of the 16 images .* missing"):
        load_capture(tmp_path / "a")
    edit(tmp_path / "a" / "transforms.json", lambda c: c.update(ply_file_path="mask.png"))
    refused(tmp_path / "a", "mask.png: it is a pipe or a device")
    (tmp_path / "a" / "transforms.json").unlink()
    os.mkfifo(tmp_path / "a" / "transforms.json")
    with pytest.raises(CaptureError, match="it is a pipe or a device"):
        load_capture(tmp_path / "a", format="transforms")
    os.mkfifo(tmp_path / "a.npz")
    with pytest.raises(CaptureError, match="it is a pipe or a device"):
        load_capture(tmp_path / "a.npz")
