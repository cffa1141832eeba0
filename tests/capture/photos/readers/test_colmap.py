"""COLMAP's sparse models: binary and text, every camera model, damaged files, and a real one."""

from __future__ import annotations

import shutil
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from capture.damage import damaged_copies
from capture.photos.photo_checks import check_sentence, check_views, seen_at
from capture.photos.photo_scene import CAMERA, FOCAL, HEIGHT, POINTS, WIDTH, project, save, write_colmap

from difftetvr.capture import CaptureWarning, load_capture
from difftetvr.capture.photos.readers.colmap import read_colmap_model
from difftetvr.errors import CaptureError
from difftetvr.rendering import LensCamera

BOX = (-1.0, -1.5, -1.0, 1.5, 1.0, 1.5)
MIDDLE = (WIDTH / 2, HEIGHT / 2)


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_views_points_and_split(tmp_path: Path, suffix: str) -> None:
    poses = write_colmap(tmp_path / "ball", suffix)
    capture = load_capture(tmp_path / "ball")
    check_views(capture, poses)
    assert capture.name == "ball" and capture.alphas is None and capture.encoding == "srgb"
    assert capture.test_indices.tolist() == [0, 8]
    assert capture.points is not None and capture.point_colors is not None
    np.testing.assert_allclose(capture.points, POINTS, atol=1e-6)
    np.testing.assert_allclose(capture.point_colors, [[1, 0.2, 0]] * 6, atol=1e-6)
    lower, upper = capture.bounds.numpy()
    assert (lower < POINTS.min(axis=0)).all() and (upper > POINTS.max(axis=0)).all()


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_keypoints_are_where_points_project(tmp_path: Path, suffix: str) -> None:
    write_colmap(tmp_path, suffix)
    model = read_colmap_model(tmp_path / "sparse" / "0")
    assert [len(image.keypoints) for image in model.images[1:]] == [7] * 15
    errors = model.reprojection_errors()
    assert len(errors) in (16 * 6, 15 * 6) and errors.max() < 1e-9


@pytest.mark.parametrize(
    ("model", "parameters", "distortion"),
    [
        ((0, "SIMPLE_PINHOLE"), (FOCAL, *MIDDLE), {}),
        ((1, "PINHOLE"), (FOCAL, FOCAL, *MIDDLE), {}),
        ((2, "SIMPLE_RADIAL"), (FOCAL, *MIDDLE, 0.01), {"k1": 0.01}),
        ((3, "RADIAL"), (FOCAL, *MIDDLE, 0.01, 0.02), {"k1": 0.01, "k2": 0.02}),
        (
            (4, "OPENCV"),
            (FOCAL, FOCAL, *MIDDLE, 0.01, 0.02, 0.003, 0.004),
            {"k1": 0.01, "k2": 0.02, "p1": 0.003, "p2": 0.004},
        ),
        (
            (6, "FULL_OPENCV"),
            (FOCAL, FOCAL, *MIDDLE, 0.01, 0.02, 0.003, 0.004, 0.005, 0.006, 0.007, 0.008),
            {"k1": 0.01, "k2": 0.02, "p1": 0.003, "p2": 0.004, "k3": 0.005, "k4": 0.006, "k5": 0.007, "k6": 0.008},
        ),
        ((7, "FOV"), (FOCAL, FOCAL, *MIDDLE, 0.3), {"omega": 0.3}),
        ((12, "SIMPLE_DIVISION"), (FOCAL, *MIDDLE, -0.05), {"k": -0.05}),
        ((13, "DIVISION"), (FOCAL, FOCAL, *MIDDLE, 0.02), {"k": 0.02}),
        ((16, "EUCM"), (FOCAL, FOCAL, *MIDDLE, 0.3, 1.1), {"alpha": 0.3, "beta": 1.1}),
    ],
)
@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_camera_models(tmp_path: Path, suffix: str, model, parameters, distortion: dict) -> None:
    write_colmap(tmp_path, suffix, model, parameters)
    lens = read_colmap_model(tmp_path / "sparse" / "0").cameras[7]
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == (FOCAL, FOCAL, *MIDDLE)
    assert {key: value for key, value in lens.distortion.values.items() if value} == distortion
    assert load_capture(tmp_path).images.shape == (16, HEIGHT, WIDTH, 3)


@pytest.mark.parametrize(
    ("model", "parameters", "lens"),
    [
        ((5, "OPENCV_FISHEYE"), (FOCAL, FOCAL, *MIDDLE, 0.01, 0.02, 0.003, 0.004), "fisheye"),
        ((8, "SIMPLE_RADIAL_FISHEYE"), (FOCAL, *MIDDLE, 0.01), "fisheye"),
        ((9, "RADIAL_FISHEYE"), (FOCAL, *MIDDLE, 0.01, 0.02), "fisheye"),
        ((10, "THIN_PRISM_FISHEYE"), (FOCAL, FOCAL, *MIDDLE, *np.arange(1, 9) * 1e-3), "thin-prism-fisheye"),
        (
            (11, "RAD_TAN_THIN_PRISM_FISHEYE"),
            (FOCAL, FOCAL, *MIDDLE, *np.arange(1, 13) * 1e-3),
            "rad-tan-thin-prism-fisheye",
        ),
        ((14, "SIMPLE_FISHEYE"), (FOCAL, *MIDDLE), "fisheye"),
        ((15, "FISHEYE"), (FOCAL, FOCAL, *MIDDLE), "fisheye"),
    ],
)
@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_fisheyes_are_kept(tmp_path: Path, suffix: str, model, parameters, lens: str) -> None:
    write_colmap(tmp_path, suffix, model, parameters)
    with pytest.raises(CaptureError, match=r"is a fisheye, .*--keep-lens") as error:
        load_capture(tmp_path)
    check_sentence(error.value)
    camera = load_capture(tmp_path, keep_lens=True).cameras[3]
    assert isinstance(camera, LensCamera) and camera.model == lens
    coefficients = parameters[4:] if parameters[1] == FOCAL else parameters[3:]
    np.testing.assert_array_equal(camera.coefficients, coefficients)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (FOCAL, FOCAL, *MIDDLE)


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
@pytest.mark.parametrize("model", [(17, "EQUIRECTANGULAR"), (99, "MADE_UP")])
def test_other_camera_models_are_refused(tmp_path: Path, suffix: str, model: tuple[int, str]) -> None:
    write_colmap(tmp_path, suffix, model, (1.0,) * 8)
    with pytest.raises(CaptureError, match="not supported; undistort") as error:
        load_capture(tmp_path)
    check_sentence(error.value)


def test_every_place_of_a_model(tmp_path: Path) -> None:
    poses = write_colmap(tmp_path)
    check_views(load_capture(tmp_path / "sparse" / "0"), poses)
    # Newer versions of COLMAP write these, too.
    (tmp_path / "sparse" / "0" / "rigs.bin").write_bytes(b"rigs")
    (tmp_path / "sparse" / "0" / "frames.bin").write_bytes(b"frames")
    check_views(load_capture(tmp_path), poses)
    for file in (tmp_path / "sparse" / "0").iterdir():
        shutil.move(str(file), tmp_path / "sparse")
    check_views(load_capture(tmp_path), poses)
    for file in (tmp_path / "sparse").glob("*.bin"):
        shutil.move(str(file), tmp_path)
    check_views(load_capture(tmp_path), poses)


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_the_model_with_the_most_images_is_read(tmp_path: Path, suffix: str) -> None:
    poses = write_colmap(tmp_path, suffix)
    sparse = tmp_path / "sparse"
    (sparse / "0").rename(sparse / "10")
    for name, images in (("0", ""), ("2", "# none\n")):
        (sparse / name).mkdir()
        (sparse / name / "cameras.txt").write_text(f"7 PINHOLE {WIDTH} {HEIGHT} 50 50 30 20\n")
        (sparse / name / "images.txt").write_text(images)
    for folder in (tmp_path, sparse):
        with pytest.warns(
            CaptureWarning, match=r"Of 3 sparse models, .*10' with 16 images is read; not .*0' .0."
        ) as said:
            check_views(load_capture(folder), poses)
        assert len(said) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_views(load_capture(sparse / "10"), poses)


def test_masks_beside_the_images(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    mask = np.full((HEIGHT, WIDTH), 255, dtype=np.uint8)
    mask[:, :9] = 0
    names = [f"{i:03}.png.png" for i in range(7)] + [f"{i:03}.png" for i in range(7, 15)]
    for name in names:
        save(tmp_path / "masks" / name, mask)
    with pytest.warns(CaptureWarning, match="1 of the 16 images have no mask"):
        capture = load_capture(tmp_path)
    assert capture.valid is not None and capture.valid[15].all()
    assert all(torch.equal(capture.valid[view], torch.from_numpy(mask > 0)) for view in range(15))
    shutil.rmtree(tmp_path / "masks")
    (tmp_path / "masks").mkdir()
    with pytest.warns(CaptureWarning, match=r"16 of the 16 .* such as 000.png.png; all their pixels are used"):
        assert load_capture(tmp_path).valid is None


def test_smaller_copies_with_other_suffixes_and_rounded_sizes(tmp_path: Path) -> None:
    poses = write_colmap(tmp_path)
    for index in range(16):
        # 60 x 40 by 8 is 7.5 x 5.
        save(tmp_path / "images_8" / f"{index:03}.JPG", np.full((5, 8, 3), 90, dtype=np.uint8))
    capture = load_capture(tmp_path, downscale=8)
    np.testing.assert_allclose(seen_at(capture.cameras[3]), project(poses[3]) * (8 / WIDTH, 5 / HEIGHT), atol=1e-3)
    shutil.rmtree(tmp_path / "images")
    with pytest.raises(CaptureError, match="a downscale that 'images_8' fits") as error:
        load_capture(tmp_path)
    check_sentence(error.value)
    save(tmp_path / "images_8" / "000.JPG", np.full((5, 10, 3), 90, dtype=np.uint8))
    with pytest.raises(CaptureError, match="10 x 5 pixels but its camera 60 x 40, shrunk by 8"):
        load_capture(tmp_path, downscale=8)


def test_incomplete_models(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    sparse = tmp_path / "sparse" / "0"
    (sparse / "points3D.bin").unlink()
    capture = load_capture(tmp_path)
    assert capture.points is None and (capture.bounds[0] < -0.3).all()
    original = (sparse / "images.bin").read_bytes()
    (sparse / "images.bin").write_bytes(struct.pack("<Q", 0))
    with pytest.raises(CaptureError, match="no registered image"):
        load_capture(tmp_path)
    (sparse / "images.bin").write_bytes(original)
    (sparse / "cameras.bin").write_bytes(struct.pack("<QIiQQ3d", 1, 8, 0, WIDTH, HEIGHT, FOCAL, *MIDDLE))
    with pytest.raises(CaptureError, match="the camera 7, which the model lacks"):
        load_capture(tmp_path)
    (tmp_path / "images").rename(tmp_path / "photos")
    with pytest.raises(CaptureError, match=r"lacks|no folder 'images'"):
        load_capture(tmp_path)
    (sparse / "cameras.bin").unlink()
    with pytest.raises(CaptureError, match="holds no capture that is known"):
        load_capture(tmp_path)
    with pytest.raises(CaptureError, match="no sparse model"):
        load_capture(tmp_path, format="colmap")


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
@pytest.mark.parametrize("part", ["cameras", "images", "points3D"])
def test_damaged_files_give_a_sentence(tmp_path: Path, part: str, suffix: str) -> None:
    write_colmap(tmp_path, suffix)
    path = tmp_path / "sparse" / "0" / f"{part}{suffix}"
    failures = 0
    for data in damaged_copies(path.read_bytes(), seed=3, count=60):
        path.write_bytes(data)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                read_colmap_model(path.parent)
            except CaptureError as error:
                failures += 1
                check_sentence(error)
    assert failures >= (20 if suffix == ".bin" else 8)


def test_cut_files_name_the_file(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    for part in ("cameras", "images", "points3D"):
        path = tmp_path / "sparse" / "0" / f"{part}.bin"
        data = path.read_bytes()
        for cut in (data[:-1], data[: len(data) // 2], data[:5], b""):
            path.write_bytes(cut)
            with pytest.raises(CaptureError, match=rf"{part}.bin' is damaged .*(cut short|does not end)"):
                load_capture(tmp_path)
        path.write_bytes(data + b"\0")
        with pytest.raises(CaptureError, match="goes on after its last record"):
            load_capture(tmp_path)
        path.write_bytes(struct.pack("<Q", 2**60) + data[8:])
        with pytest.raises(CaptureError, match="cut short"):
            load_capture(tmp_path)
        path.write_bytes(data)


@pytest.mark.parametrize("number", ["nan", "1e300", "-inf"])
def test_numbers_of_points_are_numbers(tmp_path: Path, number: str) -> None:
    write_colmap(tmp_path, ".txt")
    path = tmp_path / "sparse" / "0" / "images.txt"
    lines = path.read_text().split("\n")
    row = next(index for index, line in enumerate(lines) if line and not line.startswith("#"))
    lines[row + 1] = f"1.5 2.5 {number}"
    path.write_text("\n".join(lines))
    with pytest.raises(CaptureError, match=f"damaged .*line {row + 2 - 1} cannot be read"):
        load_capture(tmp_path)


def test_models_of_other_images_are_refused(tmp_path: Path) -> None:
    values = {**CAMERA, "cx": -400.0}
    write_colmap(tmp_path, ".txt", parameters=tuple(values.values()))
    with pytest.raises(CaptureError, match="do not project to where") as error:
        load_capture(tmp_path)
    check_sentence(error.value)


def test_real_model(shared_data: Path) -> None:
    folder = shared_data / "colmap"
    if not folder.is_dir():
        pytest.skip("no colmap")
    errors = read_colmap_model(folder / "sparse" / "0").reprojection_errors()
    assert len(errors) == 5931 and np.median(errors) < 0.3 and errors.max() < 2.0
    with pytest.warns(CaptureWarning, match="cropped .* to 250 x 164"):
        capture = load_capture(folder, downscale=4)
    assert capture.points is not None and capture.points.shape == (1443, 3)
    # Features do not move when images shrink and are cropped at the right and bottom.
    model = read_colmap_model(folder / "sparse" / "0")
    positions = dict(zip(model.points.ids.tolist(), model.points.positions, strict=True))
    for camera, image in zip(capture.cameras, model.images, strict=True):
        known = image.point_ids >= 0
        points = np.array([positions[key] for key in image.point_ids[known].tolist()])
        distances = np.linalg.norm(seen_at(camera, points) - image.keypoints[known] / 4, axis=1)
        assert np.median(distances) < 0.15
    inside = ((capture.points > capture.bounds[0]) & (capture.points < capture.bounds[1])).all(dim=1)
    assert float(inside.float().mean()) > 0.95 and torch.isfinite(capture.bounds).all()
