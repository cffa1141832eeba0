"""Cameras as files of their own."""

import json

import pytest
import torch

import difftetvr as dtv
from difftetvr.rendering import load_camera, save_camera


@pytest.mark.parametrize(("place", "dtype"), [(0.0, torch.float32), (1e3, torch.float64)])
def test_a_camera_comes_back_to_the_bit(tmp_path, place, dtype):
    camera = dtv.Camera.look_at((1.1 + place, -2.3, 0.7), (0.1 + place, 0.0, 0.2), fov_y=0.8, width=40, height=30)
    save_camera(tmp_path / "camera.json", camera)
    back = load_camera(tmp_path / "camera.json")
    assert torch.equal(back.world_to_camera, camera.world_to_camera) and back.world_to_camera.dtype == dtype
    assert [getattr(back, n) for n in ("fx", "fy", "cx", "cy", "width", "height")] == [
        getattr(camera, n) for n in ("fx", "fy", "cx", "cy", "width", "height")
    ]


GOOD = {
    "format": "difftetvr-camera",
    "world_to_camera": torch.eye(4).tolist(),
    **dict.fromkeys(("fx", "fy", "cx", "cy"), 5.0),
    **dict.fromkeys(("width", "height"), 10),
}


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"format": "else"}, "does not have the format"),
        ({"fx": -1.0}, "greater than 0"),
        ({"width": 2.5}, "width"),
        ({"cx": "left"}, "cx"),
        ({"world_to_camera": "here"}, "no matrix of numbers"),
        ({"world_to_camera": [[1.0]]}, "shape"),
        ({"world_to_camera": (2.0 * torch.eye(4)).tolist()}, "no rigid transform"),
    ],
)
def test_wrong_content_is_one_sentence(tmp_path, change, sentence):
    (tmp_path / "camera.json").write_text(json.dumps(GOOD | change))
    with pytest.raises(dtv.CameraError, match=sentence):
        load_camera(tmp_path / "camera.json")


def test_missing_and_broken_files_are_one_sentence(tmp_path):
    with pytest.raises(dtv.CameraError, match="Cannot read"):
        load_camera(tmp_path / "none.json")
    (tmp_path / "camera.json").write_text("{")
    with pytest.raises(dtv.CameraError, match="not valid JSON"):
        load_camera(tmp_path / "camera.json")
    (tmp_path / "camera.json").write_text(json.dumps({k: v for k, v in GOOD.items() if k != "cy"}))
    with pytest.raises(dtv.CameraError, match="no 'cy'"):
        load_camera(tmp_path / "camera.json")


def test_only_pinholes_are_saved(tmp_path):
    with pytest.raises(dtv.CameraError, match="Only pinhole cameras"):
        save_camera(tmp_path / "camera.json", dtv.PanoramicCamera(torch.eye(4), 8, 4))
