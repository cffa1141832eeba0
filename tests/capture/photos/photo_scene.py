"""A ball photographed from around, and the same photographs written in every format, without the package's code."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path

import numpy as np
from PIL import Image

WIDTH, HEIGHT, FOCAL = 60, 40, 50.0
CENTER, RADIUS = np.array([0.3, -0.2, 0.1]), 0.7
COLOR = np.array([200, 100, 50])
POINTS = CENTER + RADIUS * np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]])
CAMERA = {"fx": FOCAL, "fy": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2}


def look_at(eye: np.ndarray, target: np.ndarray = CENTER) -> np.ndarray:
    """(4, 4) world-to-camera, OpenCV axes."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = [right, np.cross(forward, right), forward]
    pose[:3, 3] = -pose[:3, :3] @ eye
    return pose


def orbit(count: int = 16) -> list[np.ndarray]:
    """World-to-camera of views from around, above and below."""
    angles = np.arange(count) * math.pi * (3 - math.sqrt(5))
    heights = np.linspace(-0.8, 0.8, count)
    around = np.sqrt(1 - heights**2)
    eyes = CENTER + 4.0 * np.stack([around * np.cos(angles), around * np.sin(angles), heights], axis=1)
    return [look_at(eye) for eye in eyes]


def project(pose: np.ndarray, points: np.ndarray = POINTS) -> np.ndarray:
    """(P, 2) pixels of points."""
    local = points @ pose[:3, :3].T + pose[:3, 3]
    return FOCAL * local[:, :2] / local[:, 2:] + (WIDTH / 2, HEIGHT / 2)


def picture(pose: np.ndarray) -> np.ndarray:
    """(H, W, 4) uint8 image of the ball, transparent around it."""
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    rays = np.stack([x / FOCAL, y / FOCAL, np.ones_like(x)], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    center = pose[:3, :3] @ CENTER + pose[:3, 3]
    hit = np.linalg.norm(np.cross(rays, center), axis=-1) < RADIUS
    return np.concatenate([np.where(hit[..., None], COLOR, 0), 255 * hit[..., None]], axis=-1).astype(np.uint8)


def on_grey(values: np.ndarray) -> np.ndarray:
    """(H, W, 3) opaque image."""
    return np.where(values[..., 3:] > 0, values[..., :3], 90).astype(np.uint8)


def opengl(pose: np.ndarray) -> list[list[float]]:
    """Camera-to-world in OpenGL axes, as NeRF stores it."""
    return (np.linalg.inv(pose) @ np.diag([1.0, -1, -1, 1])).tolist()


def save(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(values).save(path)


def dump(path: Path, content: object) -> None:
    path.write_text(json.dumps(content))


def write_nerf_synthetic(folder: Path, test_listed: int = 4) -> list[np.ndarray]:
    """12 views for training, 4 for testing; returns the poses in that order."""
    poses = orbit()
    angle = 2 * math.atan(0.5 * WIDTH / FOCAL)
    for split, views in (("train", poses[:12]), ("test", poses[12:])):
        frames = []
        for index, pose in enumerate(views):
            save(folder / split / f"r_{index}.png", picture(pose))
            frames.append({"file_path": f"./{split}/r_{index}", "transform_matrix": opengl(pose)})
        if split == "test":
            frames += [{**frames[-1], "file_path": f"./test/r_{i}"} for i in range(4, test_listed)]
        dump(folder / f"transforms_{split}.json", {"camera_angle_x": angle, "frames": frames})
    return poses


def write_transforms(folder: Path, suffix: str = ".png", **top: object) -> list[np.ndarray]:
    """16 views in a transforms.json as nerfstudio writes it; returns the poses in the order of their names."""
    poses = orbit()
    frames = []
    for index, pose in reversed(list(enumerate(poses))):
        values = picture(pose)
        save(folder / "images" / f"{index:03}{suffix}", values if suffix == ".png" else on_grey(values))
        frames.append({"file_path": f"images/{index:03}{suffix}", "transform_matrix": opengl(pose)})
    intrinsics = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": float(WIDTH), "h": HEIGHT}
    dump(folder / "transforms.json", {**intrinsics, **top, "frames": frames})
    return poses


def write_camera_list(folder: Path, **top: object) -> list[np.ndarray]:
    poses, cameras = orbit(), []
    for index, pose in enumerate(poses):
        save(folder / f"{index:03}.png", picture(pose))
        cameras.append({"image": f"{index:03}.png", "world_to_camera": pose.tolist(), **CAMERA})
    dump(folder / "cameras.json", {"format": "difftetvr-cameras", "cameras": cameras, **top})
    return poses


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """(w, x, y, z), from the eigenvector that belongs to it."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    matrix = [
        [a - e - i, d + b, g + c, h - f],
        [d + b, e - a - i, h + f, c - g],
        [g + c, h + f, i - a - e, d - b],
        [h - f, c - g, d - b, a + e + i],
    ]
    x, y, z, w = np.linalg.eigh(np.array(matrix) / 3)[1][:, -1]
    return np.array([w, x, y, z])


def write_colmap(
    folder: Path, suffix: str = ".bin", model: tuple[int, str] = (1, "PINHOLE"), parameters: tuple[float, ...] = ()
) -> list[np.ndarray]:
    """16 photographs on grey and a sparse model of 6 points, each seen in every image; returns the poses."""
    poses = orbit()
    parameters = parameters or tuple(CAMERA.values())
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    for index, pose in enumerate(poses):
        save(folder / "images" / f"{index:03}.png", on_grey(picture(pose)))
    (_write_binary if suffix == ".bin" else _write_text)(sparse, poses, model, parameters)
    return poses


def _write_binary(sparse: Path, poses: list[np.ndarray], model: tuple[int, str], parameters: tuple[float, ...]) -> None:
    camera = struct.pack(f"<QIiQQ{len(parameters)}d", 1, 7, model[0], WIDTH, HEIGHT, *parameters)
    images = struct.pack("<Q", len(poses))
    for index, pose in reversed(list(enumerate(poses))):
        images += struct.pack("<I7dI", 100 - index, *quaternion(pose[:3, :3]), *pose[:3, 3], 7)
        images += f"{index:03}.png".encode() + b"\0" + struct.pack("<Q", len(POINTS) + 1)
        for point, (x, y) in enumerate(project(pose)):
            images += struct.pack("<ddQ", x, y, 10 * point)
        images += struct.pack("<ddQ", 1.0, 2.0, 2**64 - 1)
    points = struct.pack("<Q", len(POINTS))
    for index, point in enumerate(POINTS):
        points += struct.pack("<Q3d3BdQ2I", 10 * index, *point, 255, 51, 0, 0.5, 1, 100, index)
    for name, content in (("cameras", camera), ("images", images), ("points3D", points)):
        (sparse / f"{name}.bin").write_bytes(content)


def _write_text(sparse: Path, poses: list[np.ndarray], model: tuple[int, str], parameters: tuple[float, ...]) -> None:
    def text(values: object) -> str:
        return " ".join(repr(float(value)) for value in values)

    camera = f"# a comment\n7 {model[1]} {WIDTH} {HEIGHT} {text(parameters)}\n"
    images = "# a comment\n"
    for index, pose in reversed(list(enumerate(poses))):
        images += f"{100 - index} {text(quaternion(pose[:3, :3]))} {text(pose[:3, 3])} 7 {index:03}.png\n"
        seen = [f"{text(pixel)} {10 * point}" for point, pixel in enumerate(project(pose))]
        images += " ".join([*seen, "1.0 2.0 -1"] if index else []) + "\n"
    points = "".join(f"{10 * i} {text(point)} 255 51 0 0.5 100 {i}\n" for i, point in enumerate(POINTS))
    for name, content in (("cameras", camera), ("images", images), ("points3D", points)):
        (sparse / f"{name}.txt").write_text(content)


def write_tiny(path: Path, channels: int = 3) -> list[np.ndarray]:
    poses = orbit()
    images = np.stack([picture(pose) for pose in poses])[..., :channels]
    np.savez(path, images=images / np.float32(255), poses=np.array([opengl(p) for p in poses]), focal=np.array(FOCAL))
    return poses


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
