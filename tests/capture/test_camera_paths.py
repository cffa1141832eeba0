"""Cameras of captures without their images, and paths through them."""

import json
import math

import numpy as np
import pytest
import torch
from capture.photos.photo_scene import write_nerf_synthetic

import difftetvr as dtv
from difftetvr.capture import CameraSet, fibonacci_orbit, load_cameras
from difftetvr.capture.camera_paths import ellipse, interpolated, key_cameras_of, load_camera_path, turntable
from difftetvr.errors import CameraError
from difftetvr.rendering import save_camera


def around(angles, radius=2.0, height=0.5, center=(1.0, 2.0, 3.0)):
    """Cameras on a circle around an upright axis, which look at its middle."""
    x, y, z = center
    return [
        dtv.Camera.look_at(
            (x + radius * math.cos(a), y + radius * math.sin(a), z + height), center, width=40, height=30
        )
        for a in angles
    ]


def set_of(cameras):
    return CameraSet(cameras, torch.zeros(len(cameras), dtype=torch.bool), "orbit")


def positions(cameras):
    return np.stack([camera.position.double().numpy() for camera in cameras])


def test_cameras_are_read_without_images(tmp_path):
    write_nerf_synthetic(tmp_path / "ball")
    for source, options in ((tmp_path / "ball", {"downscale": 2}), ("tooth", {"views": 7, "width": 8, "height": 6})):
        whole, views = dtv.load_capture(source, **options), load_cameras(source, **options)
        assert torch.equal(views.test, whole.test) and views.name == whole.name
        for one, other in zip(views.cameras, whole.cameras, strict=True):
            assert torch.equal(one.world_to_camera, other.world_to_camera)
            assert (one.fx, one.cy, one.width, one.height) == (other.fx, other.cy, other.width, other.height)
    whole.save(tmp_path / "saved.npz")
    assert len(load_cameras(tmp_path / "saved.npz").cameras) == 7
    # Nothing but the headers is looked at: what follows them may be gone.
    for image in (tmp_path / "ball").rglob("*.png"):
        image.write_bytes(image.read_bytes()[:60])
    assert len(load_cameras(tmp_path / "ball").cameras) > 0


def test_the_focus_and_the_typical_camera_of_an_orbit():
    views = set_of(around(np.linspace(0, 2 * np.pi, 12, endpoint=False)))
    assert np.allclose(views.focus, (1, 2, 3), atol=1e-5) and np.allclose(views.up, (0, 0, 1), atol=1e-5)
    # All around there is no side, so it is the one nearest to the usual direction: in front, to the right.
    offset = views.typical.position.double().numpy() - (1, 2, 3)
    assert abs(math.atan2(offset[1], offset[0]) - math.atan2(-1.0, 0.45)) < np.pi / 12
    assert np.allclose(views.inner_bounds.mean(0), (1, 2, 3), atol=1e-5)


def test_the_typical_camera_of_a_side_is_its_middle_and_no_view_held_out():
    cameras = around(np.radians([0, 20, 40, 41, 60, 80]))
    views = CameraSet(cameras, torch.tensor([False, False, True, False, False, False]), "side")
    assert views.typical is cameras[3]


def test_parallel_cameras_look_at_something_in_front_of_them():
    cameras = [dtv.Camera.look_at((x, -5.0, 0.0), (x, 0.0, 0.0)) for x in (-1.0, 0.0, 1.0)]
    assert np.allclose(set_of(cameras).focus, (0, -4, 0), atol=1e-6)


def test_a_path_runs_through_its_cameras_and_around_what_they_look_at():
    keys = around(np.radians([0, 90, 180, 270]))
    path = interpolated(keys, 301)
    places = positions(path)
    for key in keys:
        gaps = [float((camera.world_to_camera - key.world_to_camera).abs().max()) for camera in path]
        assert min(gaps) < 0.02, "some frame is where each camera is"
    assert torch.allclose(path[0].world_to_camera, keys[0].world_to_camera.double(), atol=1e-6)
    assert torch.allclose(path[-1].world_to_camera, keys[-1].world_to_camera.double(), atol=1e-6)
    radius = np.linalg.norm(places - (1, 2, 3.5), axis=1)
    assert abs(radius - 2.0).max() < 0.05, "chords would come as near as 1.41"
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert steps.max() < 1.1 * steps.min(), "the film neither hurries nor lingers"


def test_a_path_through_cameras_side_by_side_is_straight():
    keys = [dtv.Camera.look_at((x, -5.0, 0.0), (x, 0.0, 0.0)) for x in (0.0, 1.0, 1.5, 4.0)]
    places = positions(interpolated(keys, 9))
    assert np.allclose(places[:, 0], np.linspace(0, 4, 9), atol=0.05) and np.allclose(places[:, 1:], (-5, 0), atol=1e-9)


def test_a_closed_path_has_no_seam():
    path = positions(interpolated(around(np.radians([0, 72, 144, 216, 288])), 60, loop=True))
    steps = np.linalg.norm(np.roll(path, -1, axis=0) - path, axis=1)
    assert steps.max() < 1.1 * steps.min(), "from the last frame to the first it is as far as between others"


def test_focal_lengths_are_led_along_and_repetitions_count_once():
    near, far = around([0.0, 0.5])
    far = dtv.Camera(far.world_to_camera, 4 * far.fx, 4 * far.fy, 80.0, 60.0, 160, 120)
    path = interpolated([near, near, far, far], 3)
    assert {(camera.width, camera.height) for camera in path} == {(40, 30)}
    assert [camera.fx for camera in path] == pytest.approx([near.fx] * 3, rel=1e-6)
    assert [camera.cx for camera in path] == pytest.approx([20.0] * 3)
    assert len(interpolated([near, near], 4)) == 4 and len(interpolated([near], 1)) == 1
    for cameras, frames in (([], 3), ([near], 0)):
        with pytest.raises(CameraError):
            interpolated(cameras, frames)


def test_key_cameras_follow_each_other():
    order = np.random.default_rng(0).permutation(40)
    views = set_of([around(np.linspace(0, np.pi, 40))[k] for k in order])
    keys = positions(key_cameras_of(views, 120))
    assert len(keys) == 10
    angles = np.arctan2(keys[:, 1] - 2.0, keys[:, 0] - 1.0)
    assert (np.diff(angles) > 0).all() or (np.diff(angles) < 0).all(), "in whatever order the files have them"


def test_a_turntable_goes_around_once():
    (start,) = around([0.3])
    path = turntable(start, 8, (1.0, 2.0, 3.0), (0.0, 0.0, 2.0))
    assert torch.allclose(path[0].world_to_camera, start.world_to_camera.double(), atol=1e-6)
    wanted = around(0.3 + np.linspace(0, 2 * np.pi, 8, endpoint=False))
    assert np.allclose(positions(path), positions(wanted), atol=1e-5)
    for camera, other in zip(path, wanted, strict=True):
        assert torch.allclose(camera.world_to_camera.float(), other.world_to_camera, atol=1e-5)
    with pytest.raises(CameraError, match="up vector other than 0"):
        turntable(start, 3, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def test_an_ellipse_goes_around_an_orbit_and_stays_on_a_side():
    path = ellipse(set_of(around(np.linspace(0, 2 * np.pi, 24, endpoint=False))), 16)
    offsets = positions(path) - (1, 2, 3.5)
    assert np.allclose(np.linalg.norm(offsets, axis=1), 2.0, atol=0.1) and np.allclose(offsets[:, 2], 0, atol=1e-5)
    turned = np.unwrap(np.arctan2(offsets[:, 1], offsets[:, 0]))
    assert (np.diff(turned) > 0).all(), "counter-clockwise from above, as turntables"
    center, enlarged = path[5].project(torch.tensor([[1.0, 2.0, 3.0]], dtype=torch.float64))
    assert enlarged > 0 and np.allclose(center, (20, 15), atol=1e-3)
    side = positions(ellipse(set_of(around(np.radians(np.linspace(-40, 40, 9)))), 16))
    assert (side[:, 0] > 2.0).all()
    same = dtv.Camera.look_at((3.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    with pytest.raises(CameraError, match="all are in one place"):
        ellipse(set_of([same, same, same]), 4)


def test_files_of_paths(tmp_path):
    keys = fibonacci_orbit(3, width=20, height=10)
    entries = []
    for key in keys:
        save_camera(tmp_path / "camera.json", key)
        entries.append(json.loads((tmp_path / "camera.json").read_text()))
    file = tmp_path / "path.json"
    file.write_text(json.dumps({"format": "difftetvr-camera-path", "cameras": entries, "frames": 7, "fps": 12}))
    path = load_camera_path(file)
    assert (len(path.cameras_of_frames()), len(path.cameras_of_frames(4)), path.fps, path.loop) == (7, 4, 12, False)
    file.write_text(json.dumps({"format": "difftetvr-camera-path", "cameras": entries}))
    frames = load_camera_path(file).cameras_of_frames()
    assert all(torch.equal(a.world_to_camera, b.world_to_camera) for a, b in zip(frames, keys, strict=True))


def test_paths_of_nerfstudio(tmp_path):
    (camera,) = around([0.7])
    opengl = (camera.camera_to_world.double() @ torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]).double())).flatten()
    fov = math.degrees(2 * math.atan(0.5 * camera.height / camera.fy))
    content = {"camera_type": "perspective", "render_width": 40, "render_height": 30, "fps": 30}
    content["camera_path"] = [{"camera_to_world": opengl.tolist(), "fov": fov, "aspect": 4 / 3}] * 2
    (tmp_path / "path.json").write_text(json.dumps(content))
    path = load_camera_path(tmp_path / "path.json")
    assert (len(path.cameras_of_frames()), path.fps, path.frames) == (2, 30, None)
    assert torch.allclose(path.cameras[0].world_to_camera.float(), camera.world_to_camera, atol=1e-5)
    assert path.cameras[1].fy == pytest.approx(camera.fy)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("{", "is not valid JSON"),
        ("[1]", "is no camera path"),
        ('{"format": "difftetvr-camera-path", "cameras": []}', "has no cameras"),
        ('{"format": "difftetvr-camera-path", "cameras": [{}]}', "camera 0 of the path .* has no 'world_to_camera'"),
        ('{"camera_path": [{}]}', "has no render_width and render_height"),
        ('{"camera_path": [{}], "render_width": 4, "render_height": 4}', "fov of camera 0"),
        ('{"camera_path": [{"fov": 50}], "render_width": 4, "render_height": 4}', "pose of camera 0"),
        ('{"camera_path": [{}], "camera_type": "fisheye", "render_width": 4, "render_height": 4}', "only perspective"),
    ],
)
def test_paths_that_are_none_are_told(tmp_path, content, said):
    (tmp_path / "path.json").write_text(content)
    with pytest.raises(CameraError, match=said):
        load_camera_path(tmp_path / "path.json")
    with pytest.raises(CameraError, match="Cannot read"):
        load_camera_path(tmp_path / "none.json")
