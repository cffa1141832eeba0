"""transforms.json of nerfstudio and instant-ngp."""

from __future__ import annotations

import json
import math
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
    write_transforms,
)

from difftetvr.capture import CaptureWarning, load_capture
from difftetvr.errors import CaptureError


def edit(folder: Path, change) -> None:
    content = json.loads((folder / "transforms.json").read_text())
    change(content)
    dump(folder / "transforms.json", content)


def test_views_are_sorted_by_name_and_every_eighth_is_held_out(tmp_path: Path) -> None:
    poses = write_transforms(tmp_path)
    for source in (tmp_path, tmp_path / "transforms.json"):
        capture = load_capture(source)
        check_views(capture, poses)
        check_bounds(capture)
        assert capture.test_indices.tolist() == [0, 8]
    assert load_capture(tmp_path, test_every=5).test_indices.tolist() == [0, 5, 10, 15]
    assert not load_capture(tmp_path, test_every=0).test.any()


def test_frames_override_the_top(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    edit(tmp_path, lambda c: c["frames"][0].update(fl_x=70.0, cx=33.0))
    cameras = load_capture(tmp_path).cameras
    # The frames are written in reversed order.
    assert (cameras[15].fx, cameras[15].fy, cameras[15].cx) == (70.0, FOCAL, 33.0)
    assert (cameras[0].fx, cameras[0].cx) == (FOCAL, WIDTH / 2)


def test_angles_stand_in_for_focal_lengths(tmp_path: Path) -> None:
    write_transforms(tmp_path, fl_x=None, fl_y=None, cx=None, cy=None, w=None, h=None, camera_angle_x=1.0)
    camera = load_capture(tmp_path).cameras[0]
    assert camera.fx == camera.fy == pytest.approx(0.5 * WIDTH / math.tan(0.5))
    assert (camera.cx, camera.cy) == (WIDTH / 2, HEIGHT / 2)
    edit(tmp_path, lambda c: c.update(camera_angle_y=0.5))
    assert load_capture(tmp_path).cameras[0].fy == pytest.approx(0.5 * HEIGHT / math.tan(0.25))


def test_lists_of_file_names_are_the_split(tmp_path: Path) -> None:
    names = [f"images/{i:03}.png" for i in range(16)]
    poses = write_transforms(tmp_path, train_filenames=names[2:10], test_filenames=names[:2])
    capture = load_capture(tmp_path)
    check_views(capture, poses[:10])
    assert capture.test_indices.tolist() == [0, 1]
    with pytest.raises(CaptureError, match="leave out test_every"):
        load_capture(tmp_path, test_every=4)


def test_lists_of_images_beside_the_file_and_absolute_ones(tmp_path: Path) -> None:
    poses = write_transforms(tmp_path)

    def rename(content: dict) -> None:
        for index, frame in enumerate(content["frames"]):
            name = Path(frame["file_path"]).name
            (tmp_path / frame["file_path"]).rename(tmp_path / name)
            frame["file_path"] = name if index % 2 else str(tmp_path / name)
        content |= {"train_filenames": [f"{i:03}.png" for i in range(4)], "test_filenames": [str(tmp_path / "005.png")]}

    edit(tmp_path, rename)
    capture = load_capture(tmp_path)
    check_views(capture, [*poses[:4], poses[5]])
    assert capture.test_indices.tolist() == [4]


def test_instant_ngp_box(tmp_path: Path) -> None:
    write_transforms(tmp_path, suffix=".jpg", aabb_scale=2)
    np.testing.assert_allclose(load_capture(tmp_path).bounds, [[-0.5 / 0.33] * 3, [0.5 / 0.33] * 3], rtol=1e-6)
    edit(tmp_path, lambda c: c.update(aabb_scale=1, scale=0.5, offset=[0.5, 0.25, 0.5]))
    np.testing.assert_allclose(load_capture(tmp_path).bounds, [[-1, -0.5, -1], [1, 1.5, 1]])
    # Silhouettes say more.
    write_transforms(tmp_path / "alpha", aabb_scale=2)
    check_bounds(load_capture(tmp_path / "alpha"))


def test_bounds_by_the_cameras_alone(tmp_path: Path) -> None:
    write_transforms(tmp_path, suffix=".jpg")
    capture = load_capture(tmp_path)
    lower, upper = capture.bounds.numpy()
    # At the ball, 4 away, the images are 3.2 high; the cameras stand 8 apart.
    assert (lower < -0.8).all() and (upper > 0.8).all() and (upper - lower < 7.2).all()
    given = load_capture(tmp_path, bounds=(-1, -2, -3, 1, 2, 3))
    assert given.bounds.tolist() == [[-1, -2, -3], [1, 2, 3]]


def write_ply(path: Path, kind: str, colors: str | None = "uchar", before: str = "") -> None:
    """The points of the scene, red, as text or binary, with normals that nobody asked for and faces behind."""
    properties = [("float", name) for name in ("x", "nx", "y", "z")]
    properties += [(colors, name) for name in ("red", "green", "blue")] if colors else []
    lines = ["ply", f"format {kind} 1.0", "comment made for a test", *([before] if before else [])]
    lines += [f"element vertex {len(POINTS)}", *(f"property {type_} {name}" for type_, name in properties)]
    header = "\n".join([*lines, "element face 1", "property list uchar int vertex_indices", "end_header\n"]).encode()
    most = 1.0 if colors == "float" else 255
    rows = [[x, 0, y, z, *([most, 0, 0] if colors else [])] for x, y, z in POINTS.tolist()]
    if kind == "ascii":
        path.write_bytes(header + "\n".join(" ".join(map(str, row)) for row in rows).encode() + b"\n3 0 1 2\n")
        return
    order = ">" if "big" in kind else "<"
    code = {"float": "f4", "uchar": "u1"}
    records = np.array([tuple(row) for row in rows], [(name, order + code[type_]) for type_, name in properties])
    path.write_bytes(header + records.tobytes() + b"\3" + np.arange(3, dtype=f"{order}i4").tobytes())


@pytest.mark.parametrize("colors", ["uchar", "float", None])
@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_sparse_points_in_a_ply_file(tmp_path: Path, kind: str, colors: str | None) -> None:
    write_transforms(tmp_path, suffix=".jpg", ply_file_path="sparse_pc.ply")
    write_ply(tmp_path / "sparse_pc.ply", kind, colors)
    capture = load_capture(tmp_path)
    np.testing.assert_allclose(capture.points, POINTS, atol=1e-6)
    assert (capture.point_colors is None) == (colors is None)
    if colors:
        np.testing.assert_allclose(capture.point_colors, [[1, 0, 0]] * 6)
    check_bounds(capture)


def test_ply_files_that_are_missing_or_damaged(tmp_path: Path) -> None:
    write_transforms(tmp_path, suffix=".jpg", ply_file_path="sparse_pc.ply")
    path = tmp_path / "sparse_pc.ply"
    with pytest.warns(CaptureWarning, match=r"sparse_pc.ply' .* are missing"):
        assert load_capture(tmp_path).points is None
    for kind in ("ascii", "binary_little_endian"):
        write_ply(path, kind)
        whole = path.read_bytes()
        for wrong in (
            whole[:120],
            whole[: whole.index(b"end_header") + 20],
            whole.replace(b"vertex 6", b"vertex 60000000000000"),
            whole.replace(b"vertex 6", b"vertex -6"),
            whole.replace(b"vertex 6", b"vertex 1e999"),
            whole.replace(b"vertex 6", b"corner 6"),
            whole.replace(b" x\n", b" y\n"),
            whole.replace(b"float x", b"list uchar float x"),
            whole.replace(b"float x", b"quaternion x"),
            whole.replace(b"1.0", b"").replace(kind.encode(), b""),
            b"",
        ):
            path.write_bytes(wrong)
            with pytest.raises(CaptureError, match="no intact PLY file") as error:
                load_capture(tmp_path)
            check_sentence(error.value)
    write_ply(path, "ascii")
    words = path.read_bytes().split(b"end_header\n")
    path.write_bytes(words[0] + b"end_header\nnan" + words[1].lstrip(b"-.0123456789"))
    assert len(load_capture(tmp_path).points) == 5
    # No colour is that.
    path.write_bytes(path.read_bytes().replace(b" 255 ", b" nan ", 1))
    with pytest.raises(CaptureError, match="no intact PLY file"):
        load_capture(tmp_path)


def test_what_is_known_and_not_used_is_said(tmp_path: Path) -> None:
    write_transforms(tmp_path, rolling_shutter=[0, 0, 0, 1])
    edit(tmp_path, lambda c: [frame.update(depth_file_path="depth.png") for frame in c["frames"]])
    with pytest.warns(CaptureWarning, match="depth maps .* and a rolling shutter, not used") as said:
        load_capture(tmp_path)
    assert len(said) == 1


def test_masks_exclude_pixels(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    mask = np.full((HEIGHT, WIDTH), 255, dtype=np.uint8)
    mask[:7] = 0
    save(tmp_path / "masks" / "a.png", mask)
    edit(tmp_path, lambda c: c["frames"][-1].update(mask_path="masks/a.png"))
    capture = load_capture(tmp_path)
    assert capture.valid is not None and capture.valid[1:].all()
    assert torch.equal(capture.valid[0], torch.from_numpy(mask > 0))
    half = load_capture(tmp_path, downscale=2).valid
    assert half is not None and not half[0, :4].any() and half[0, 4:].all()
    # Masks that are shrunk as the smaller copies of the images are.
    save(tmp_path / "images_2" / "000.png", picture(orbit()[0])[::2, ::2])
    save(tmp_path / "masks" / "a.png", mask[::2, ::2])
    copies = load_capture(tmp_path, downscale=2).valid
    assert copies is not None and torch.equal(copies[0], torch.from_numpy(mask[::2, ::2] > 0))
    save(tmp_path / "masks" / "a.png", mask[:9])
    with pytest.raises(CaptureError, match=r"mask .* another size"):
        load_capture(tmp_path)
    (tmp_path / "masks" / "a.png").unlink()
    with pytest.raises(CaptureError, match="Cannot read the image"):
        load_capture(tmp_path)


def test_smaller_copies_are_used(tmp_path: Path) -> None:
    poses = write_transforms(tmp_path)
    for index in range(16):
        save(tmp_path / "images_2" / f"{index:03}.png", np.full((HEIGHT // 2, WIDTH // 2, 3), 77, dtype=np.uint8))
    capture = load_capture(tmp_path, downscale=2, bounds=(-1, -1, -1, 1, 1, 1))
    assert (capture.images.data == 77).all()
    np.testing.assert_allclose(seen_at(capture.cameras[3]), project(poses[3]) / 2, atol=1e-3)
    capture = load_capture(tmp_path, downscale=4, bounds=(-1, -1, -1, 1, 1, 1))
    assert capture.images.shape == (16, HEIGHT // 4, WIDTH // 4, 3) and (capture.images.data == 77).all()
    # 3 is not a multiple of 2.
    assert not (load_capture(tmp_path, downscale=3).images.data == 77).all()


def test_absent_images(tmp_path: Path) -> None:
    poses = write_transforms(tmp_path)
    for index in range(7):
        (tmp_path / "images" / f"{index:03}.png").unlink()
    with pytest.warns(CaptureWarning, match="7 of the 16 images"):
        capture = load_capture(tmp_path)
    check_views(capture, poses[7:])
    for index in range(7, 12):
        (tmp_path / "images" / f"{index:03}.png").unlink()
    with pytest.raises(CaptureError, match="12 of the 16 images") as error:
        load_capture(tmp_path)
    check_sentence(error.value)


@pytest.mark.parametrize(
    ("top", "message"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "camera model .*EQUIRECTANGULAR"),
        ({"camera_model": 3}, "camera model .* is 3"),
        ({"camera_model": "OPENCV_FISHEYE"}, "is a fisheye, .* --keep-lens"),
        ({"is_fisheye": True}, "fisheye"),
        ({"is_fisheye": True, "p1": 0.1}, "distortion p1, which the lens model 'fisheye'"),
        ({"k5": 0.1}, "distortion k5, which the lens model 'nerfstudio'"),
        ({"distortion_params": [0.1, 0.2]}, "distortion_params of .* not 6 finite numbers"),
        ({"distortion_params": ["0.1"] * 6}, "not 6 finite numbers"),
        ({"distortion_params": [True] * 6}, "not 6 finite numbers"),
        ({"distortion_params": "none"}, "not 6 finite numbers"),
        ({"omega": 0.1}, "distortion omega, which"),
        ({"camera_model": "FISHEYE624", "distortion_params": [0.1] * 6}, "not 12 finite numbers"),
        ({"is_fisheye": True, "distortion_params": [0, 0, 0, 0, 0, 0.1]}, "distortion p2, which"),
        ({"k1": -3.0}, "folds the image"),
        ({"k1": float("inf")}, "finite number"),
        ({"fl_x": -1.0}, "greater than 0"),
        ({"w": WIDTH + 1}, "60 x 40 pixels but its camera 61 x 40"),
        ({"h": 40.5}, "whole number of pixels"),
        ({"test_filenames": ["images/none.png"], "train_filenames": ["none.png"]}, "none of its frames"),
        ({"train_filenames": 3}, "no list of file names"),
        ({"aabb_scale": -1}, "aabb_scale"),
        ({"aabb_scale": 1, "offset": "far"}, "offset"),
        ({"aabb_scale": 1, "offset": [100, 100, 100]}, "see nothing of the scene's box"),
    ],
)
def test_wrong_descriptions(tmp_path: Path, top: dict, message: str) -> None:
    write_transforms(tmp_path, suffix=".jpg", **top)
    with pytest.raises(CaptureError, match=message) as error:
        load_capture(tmp_path)
    check_sentence(error.value)


def test_broken_json(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    file = tmp_path / "transforms.json"
    for text, message in (
        (file.read_text()[:300], "no valid JSON .line 1."),
        ("[1, 2]", "no JSON object"),
        ("[" * 100_000, "no valid JSON"),
        ("{}", "lists no 'frames'"),
    ):
        file.write_text(text)
        with pytest.raises(CaptureError, match=message) as error:
            load_capture(tmp_path)
        check_sentence(error.value)
    file.write_bytes(b"\xff\xfe{}")
    with pytest.raises(CaptureError, match="no valid JSON"):
        load_capture(tmp_path)


def test_parallel_cameras_do_not_say_where_the_scene_is(tmp_path: Path) -> None:
    write_transforms(tmp_path, suffix=".jpg")
    edit(tmp_path, lambda c: [frame.update(transform_matrix=np.eye(4).tolist()) for frame in c["frames"]])
    with pytest.raises(CaptureError, match="look the same way"):
        load_capture(tmp_path)


def test_real_fox(shared_data: Path) -> None:
    if not (shared_data / "fox").is_dir():
        pytest.skip("no fox")
    with pytest.warns(CaptureWarning, match="17 of the 67"):
        capture = load_capture(shared_data / "fox", downscale=8)
    assert capture.images.shape == (50, 240, 135, 3) and capture.alphas is None
    assert capture.test_indices.tolist() == list(range(0, 50, 8))
    # Its lens hardly distorts.
    assert capture.cameras[0].fx == pytest.approx(1375.52 / 8, rel=0.02)
    assert 0.2 < float(capture.images.mean()) < 0.8
    np.testing.assert_allclose(capture.bounds[1], [0.5 / 0.33] * 3, rtol=1e-6)
    assert capture.surroundings == 8.0


def test_picture_is_seen_where_the_camera_says() -> None:
    """The scene of these tests itself: the ball's silhouette is centred where its centre projects."""
    pose = orbit()[5]
    rows, columns = np.nonzero(picture(pose)[..., 3])
    middle = project(pose, np.array([[0.3, -0.2, 0.1]]))[0]
    np.testing.assert_allclose([columns.mean() + 0.5, rows.mean() + 0.5], middle, atol=0.2)


def test_scenes_in_geographic_coordinates_are_refused(tmp_path: Path) -> None:
    write_transforms(tmp_path)

    def far(content: dict) -> None:
        for frame in content["frames"]:
            frame["transform_matrix"][1][3] += 4e6

    edit(tmp_path, far)
    with pytest.raises(CaptureError, match="too far for single precision; subtract its centre") as error:
        load_capture(tmp_path, bounds=(-1, 4e6 - 1, -1, 1, 4e6 + 1, 1))
    check_sentence(error.value)


def test_a_box_that_is_given_may_be_seen_by_few(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    # Beside the ball: nine of the fourteen training cameras look past it.
    box = (4.5, -0.3, 0.0, 4.7, -0.1, 0.2)
    assert load_capture(tmp_path, bounds=box).bounds[0].tolist() == pytest.approx(box[:3])


def test_one_training_view_is_too_few_to_find_the_scene(tmp_path: Path) -> None:
    write_transforms(tmp_path, suffix=".jpg")
    edit(tmp_path, lambda c: c.update(frames=c["frames"][:2]))
    with pytest.raises(CaptureError, match=r"One training view .*test_every 0"):
        load_capture(tmp_path)
