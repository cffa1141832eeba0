"""Captures of Polycam and Record3D, and exports that are named where they are refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from capture.photos.photo_checks import check_bounds, check_sentence, check_views
from capture.photos.photo_scene import CAMERA, FOCAL, HEIGHT, WIDTH, dump, opengl, orbit, picture, quaternion, save

from difftetvr.capture import CaptureWarning, load_capture
from difftetvr.errors import CaptureError


def write_polycam(folder: Path, prefix: str = "") -> list[np.ndarray]:
    poses = orbit()
    (folder / "keyframes" / f"{prefix}cameras").mkdir(parents=True)
    for index, pose in enumerate(poses):
        save(folder / "keyframes" / f"{prefix}images" / f"{100 + index}.png", picture(pose))
        matrix = opengl(pose)
        values = {f"t_{row}{column}": matrix[row][column] for row in range(3) for column in range(4)}
        content = {**values, **CAMERA, "width": WIDTH, "height": HEIGHT, "blur_score": 90.0}
        dump(folder / "keyframes" / f"{prefix}cameras" / f"{100 + index}.json", content)
    return poses


def write_record3d(folder: Path, **changes: object) -> list[np.ndarray]:
    poses, rows = orbit(), []
    for index, pose in enumerate(poses):
        save(folder / "rgb" / f"{index}.png", picture(pose))
        matrix = np.array(opengl(pose))
        w, x, y, z = quaternion(matrix[:3, :3])
        rows.append([x, y, z, w, *matrix[:3, 3]])
    # Column by column.
    k = [FOCAL, 0, 0, 0, FOCAL, 0, WIDTH / 2, HEIGHT / 2, 1]
    dump(folder / "metadata.json", {"poses": rows, "K": k, "w": WIDTH, "h": HEIGHT, "fps": 60, **changes})
    return poses


@pytest.mark.parametrize("prefix", ["", "corrected_"])
def test_polycam(tmp_path: Path, prefix: str) -> None:
    poses = write_polycam(tmp_path, prefix)
    capture = load_capture(tmp_path)
    check_views(capture, poses)
    check_bounds(capture)
    if prefix:  # what was not corrected is not looked at
        (tmp_path / "keyframes" / "cameras").mkdir()
        check_views(load_capture(tmp_path), poses)
    (tmp_path / "keyframes" / "depth").mkdir()
    with pytest.warns(CaptureWarning, match="depth maps .* not used"):
        load_capture(tmp_path, format="polycam")


def test_record3d(tmp_path: Path) -> None:
    # As 2 comes before 10, as in the file.
    poses = write_record3d(tmp_path)
    capture = load_capture(tmp_path)
    check_views(capture, poses)
    check_bounds(capture)
    own = [[FOCAL + index, FOCAL, WIDTH / 2, HEIGHT / 2] for index in range(16)]
    write_record3d(tmp_path, perFrameIntrinsicCoeffs=own)
    assert [camera.fx for camera in load_capture(tmp_path).cameras] == [FOCAL + index for index in range(16)]


def test_wrong_files_of_the_apps(tmp_path: Path) -> None:
    for changes, message in (
        ({"poses": [[1, 2, 3]]}, "seven numbers"),
        ({"poses": [[0, 0, 0, 1, 0, 0, 10**400]]}, "seven numbers"),
        ({"poses": [[0, 0, 0, 2, 0, 0, 0]] * 3}, "Pose 0 .* no rotation"),
        ({"poses": [[0, 0, 0, 1e200, 0, 0, 0]] * 3}, "Pose 0 .* no rotation"),
        ({"K": None}, "no intrinsics"),
        ({"w": 0.5}, "whole number of pixels"),
    ):
        write_record3d(tmp_path / "a", **changes)
        with pytest.raises(CaptureError, match=message) as error:
            load_capture(tmp_path / "a")
        check_sentence(error.value)
    write_polycam(tmp_path / "b")
    file = tmp_path / "b" / "keyframes" / "cameras" / "103.json"
    content = json.loads(file.read_text())
    for changes, message in (
        ({"t_13": None}, "103.json' lacks one of"),
        ({"fx": 10**400}, "finite number"),
        ({"t_00": 5.0}, "not rigid"),
    ):
        dump(file, {**content, **changes})
        with pytest.raises(CaptureError, match=message) as error:
            load_capture(tmp_path / "b")
        check_sentence(error.value)
    (tmp_path / "c" / "keyframes" / "cameras").mkdir(parents=True)
    with pytest.raises(CaptureError, match="export the raw data of Polycam anew"):
        load_capture(tmp_path / "c")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        (
            "cameras.xml",
            b'<?xml version="1.0"?>\n<document version="2.0.0">\n  <chunk label="a">',
            "cameras of Metashape",
        ),
        (
            "poses.csv",
            b"\xef\xbb\xbf#name,x,y,alt,heading,pitch,roll,f,px,py\na.jpg,1,2,3",
            "cameras of RealityCapture",
        ),
        ("bundle.out", b"# Bundle file v0.3\n3 0\n", "cameras of Bundler"),
        ("scan.r3d", b"PK\3\4", "a recording of Record3D"),
    ],
)
def test_known_exports_are_named(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(content)
    for source in (tmp_path, tmp_path / name):
        with pytest.raises(CaptureError, match=rf"{message}.*which are not read; .*export") as error:
            load_capture(source)
        check_sentence(error.value)
    (tmp_path / name).write_bytes(b"something else")
    with pytest.raises(CaptureError, match="holds no capture that is known"):
        load_capture(tmp_path)
    with pytest.raises(CaptureError, match="is no capture: give"):
        load_capture(tmp_path / name)
