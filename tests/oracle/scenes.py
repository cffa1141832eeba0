"""Scenes that renderers are tested on: meshes, fields and cameras, made with numpy and scipy alone.

Positions and fields are float32 values, so that float32 and float64 renderings start from the same numbers. Each scene
is drawn from its own seed. Cameras outside a mesh are placed at random, so that no ray meets an edge exactly.
Scenes and their reference images are made once and shared, so nothing may write to them.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from oracle.oracle import OracleImage, render_oracle
from scipy.spatial import Delaunay
from torch import Tensor

from difftetvr.rendering.cameras.pinhole import Camera


@dataclass(frozen=True, eq=False)
class Scene:
    """A mesh with a field, and a camera that looks at it.

    Attributes:
        vertices: (V, 3) float32.
        tets: (T, 4) int32.
        color: (V, 3) or (T, 3) float32.
        density: (V,) or (T,) float32.
        camera: The camera.
        per_cell: Whether the field is constant in each cell.
        background: (3,) float32 or None.
    """

    vertices: Tensor
    tets: Tensor
    color: Tensor
    density: Tensor
    camera: Camera
    per_cell: bool = False
    background: Tensor | None = None

    def oracle(self, nudge: tuple[float, float] = (0.0, 0.0)) -> OracleImage:
        """The reference image."""
        return _reference(self, nudge)

    @property
    def size(self) -> float:
        """Diagonal of the mesh's bounding box."""
        return float((self.vertices.amax(0) - self.vertices.amin(0)).double().norm())


@functools.lru_cache(maxsize=100)
def _reference(scene: Scene, nudge: tuple[float, float]) -> OracleImage:
    fields = scene.color, scene.density, scene.camera, scene.background
    return render_oracle(scene.vertices, scene.tets, *fields, scene.per_cell, nudge)


# ---------------------------------------------------------------------------------------------------------- meshes


def kuhn_grid(shape: tuple[int, int, int], lower: float = -0.5, upper: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and cells (T, 4) of a grid of cubes, each cut into six tetrahedra; z runs fastest."""
    nx, ny, nz = shape
    axes = [np.linspace(lower, upper, n + 1) for n in shape]
    vertices = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    corner = np.stack(np.meshgrid(np.arange(nx), np.arange(ny), np.arange(nz), indexing="ij"), axis=-1).reshape(-1, 3)
    strides = np.array([(ny + 1) * (nz + 1), nz + 1, 1])
    cells = []
    for order in itertools.permutations(range(3)):
        path = [corner]
        for axis in order:
            path.append(path[-1] + np.eye(3, dtype=int)[axis])
        cells.append(np.stack([p @ strides for p in path], axis=-1))
    return vertices, np.stack(cells, axis=1).reshape(-1, 4)


def jittered_grid(shape: tuple[int, int, int], amount: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A Kuhn grid whose vertices are moved by up to ``amount`` cube sides along each axis (0.15 inverts no cell)."""
    vertices, cells = kuhn_grid(shape)
    moves = np.random.default_rng(seed).uniform(-amount, amount, vertices.shape)
    return vertices + moves / np.array(shape), cells


def delaunay_ball(points: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Delaunay mesh of random points in a ball of radius 0.5, slivers included."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(points, 3))
    radii = 0.5 * rng.random((points, 1)) ** (1 / 3)
    vertices = (directions / np.linalg.norm(directions, axis=1, keepdims=True) * radii).astype(np.float32)
    return vertices.astype(np.float64), Delaunay(vertices.astype(np.float64)).simplices


def keep_cells(vertices: np.ndarray, cells: np.ndarray, keep: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The kept cells and the vertices that they use."""
    used, renumbered = np.unique(cells[keep], return_inverse=True)
    return vertices[used], renumbered.reshape(-1, 4)


def porous_grid(side: int, seed: int, amount: float = 0.15) -> tuple[np.ndarray, np.ndarray]:
    """A jittered grid without its middle, without a third of its cubes and without some single cells."""
    rng = np.random.default_rng(seed)
    vertices, cells = jittered_grid((side, side, side), amount, seed)
    cubes = rng.random((side, side, side)) > 0.33
    hole = slice(side // 3, side - side // 3)
    cubes[hole, hole, hole] = False
    return keep_cells(vertices, cells, np.repeat(cubes.ravel(), 6) & (rng.random(len(cells)) > 0.1))


def join(*meshes: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Several meshes as one, sharing no vertex."""
    starts = np.cumsum([0] + [len(vertices) for vertices, _ in meshes])
    cells = [cells + start for (_, cells), start in zip(meshes, starts, strict=False)]
    return np.concatenate([vertices for vertices, _ in meshes]), np.concatenate(cells)


def slabs(count: int) -> tuple[np.ndarray, np.ndarray]:
    """``count`` thin plates one behind the other along x: that many components on one ray."""
    plates = []
    for i in range(count):
        vertices, cells = jittered_grid((1, 2, 2), 0.1, i)
        plates.append((vertices * [0.4 / count, 1.0, 1.0] + [i / count - 0.5, 0.0, 0.0], cells))
    return join(*plates)


# ------------------------------------------------------------------------------------------------ fields and cameras


def make_scene(
    mesh: tuple[np.ndarray, np.ndarray],
    camera: Camera,
    seed: int = 0,
    *,
    density: float = 3.0,
    per_cell: bool = False,
    background: bool = False,
) -> Scene:
    """A scene with random colours in [0, 1] and random densities in [0, 2 ``density``]."""
    rng = np.random.default_rng(seed + 1000)
    vertices, cells = mesh
    count = len(cells) if per_cell else len(vertices)
    return Scene(
        vertices=torch.from_numpy(vertices.astype(np.float32)),
        tets=torch.from_numpy(cells.astype(np.int32)),
        color=torch.from_numpy(rng.random((count, 3), dtype=np.float32)),
        density=torch.from_numpy((2.0 * density * rng.random(count)).astype(np.float32)),
        camera=camera,
        per_cell=per_cell,
        background=torch.from_numpy(rng.random(3, dtype=np.float32)) if background else None,
    )


def random_camera(
    seed: int, distance: float = 1.3, size: tuple[int, int] = (32, 24), target: float = 0.1, fov_y: float = 0.927
) -> Camera:
    """A camera at ``distance`` from the origin in a random direction, looking near it with a random roll."""
    rng = np.random.default_rng(seed + 2000)
    eye, up = rng.normal(size=(2, 3))
    eye = distance * eye / np.linalg.norm(eye)
    target_point = rng.uniform(-target, target, 3)
    return Camera.look_at(eye.tolist(), target_point.tolist(), up.tolist(), fov_y, *size)


def camera_at(
    eye: tuple[float, float, float], seed: int, size: tuple[int, int] = (32, 24), fov_y: float = 1.2
) -> Camera:
    """A camera at an exact position with a random orientation of its own."""
    rng = np.random.default_rng(seed + 3000)
    forward, up = rng.normal(size=(2, 3))
    target = np.asarray(eye) + forward
    return Camera.look_at(eye, target.tolist(), up.tolist(), fov_y, *size)


def axis_camera(
    eye: tuple[float, float, float], focal: float, size: tuple[int, int], center: tuple[float, float]
) -> Camera:
    """A camera with the world's axes, so that camera space is world space less ``eye``, without rounding."""
    pose = torch.eye(4)
    pose[:3, 3] = -torch.tensor(eye)
    return Camera(pose, focal, focal, *center, *size)


def scaled(scene: Scene, scale: float, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Scene:
    """The same scene in another unit of length and another place: the same picture but for rounding."""
    vertices = scene.vertices * scale + torch.tensor(shift)
    pose = scene.camera.world_to_camera.clone()
    pose[:3, 3] = pose[:3, 3] * scale - pose[:3, :3] @ torch.tensor(shift)
    return replace(scene, vertices=vertices, density=scene.density / scale, camera=scene.camera.with_pose(pose))


# ------------------------------------------------------------------------------------------------------- the scenes


def _once(scenes: dict[str, Callable[[], Scene]]) -> dict[str, Callable[[], Scene]]:
    return {name: functools.cache(make) for name, make in scenes.items()}


def _delaunay(**options: bool) -> Scene:
    return make_scene(delaunay_ball(150, 1), random_camera(1), 1, **options)


def _grid(**options: bool) -> Scene:
    return make_scene(kuhn_grid((5, 4, 6)), random_camera(2), 2, **options)


def _jittered(**options: bool) -> Scene:
    return make_scene(jittered_grid((5, 5, 5), 0.15, 3), random_camera(3), 3, **options)


def _porous(**options: bool) -> Scene:
    return make_scene(porous_grid(6, 4), random_camera(4), 4, **options)


def _inside(**options: bool) -> Scene:
    return make_scene(delaunay_ball(150, 5), camera_at((0.06, -0.03, 0.02), 5), 5, **options)


def _in_hole(**options: bool) -> Scene:
    return make_scene(porous_grid(6, 6), camera_at((0.03, 0.01, -0.02), 6), 6, **options)


def _components(**options: bool) -> Scene:
    ball, grid = delaunay_ball(60, 7), jittered_grid((2, 3, 2), 0.1, 7)
    mesh = join(ball, (ball[0] * 0.4 + [1.0, 0.0, 0.0], ball[1]), (grid[0] * 0.6 + [-0.9, 0.3, 0.1], grid[1]))
    return make_scene(mesh, random_camera(7, 1.6), 7, **options)


def _beside() -> Scene:
    """A long mesh beside the camera: its boundary crosses the camera's plane, with and without the camera inside it."""
    vertices, cells = jittered_grid((3, 3, 8), 0.15, 8)
    camera = Camera.look_at((0.9, 0.1, 0.05), (0.6, 0.05, 2.0), (0.1, 1.0, 0.0), 1.5, 32, 24)
    return make_scene((vertices * [1.0, 1.0, 6.0], cells), camera, 8)


def _wide() -> Scene:
    mesh = porous_grid(6, 9)
    return make_scene(mesh, Camera.look_at((0.02, 0.03, 0.62), (0.0, 0.1, 0.0), (0.2, 1.0, 0.1), 2.6, 33, 31), 9)


def _off_centre() -> Scene:
    scene = make_scene(delaunay_ball(100, 10), random_camera(10, 1.0, size=(37, 19)), 10, background=True)
    return replace(scene, camera=replace(scene.camera, fx=61.0, fy=33.0, cx=-2.7, cy=21.2))


def _half_empty() -> Scene:
    scene = _jittered()
    return replace(scene, density=torch.where(scene.density > 3.0, scene.density, 0.0))


def _empty() -> Scene:
    scene = _jittered(background=True)
    return replace(scene, density=torch.zeros_like(scene.density))


def _dense(factor: float) -> Scene:
    """Densities over five decades up to ``factor`` per unit length, and some that are zero."""
    scene = _jittered(background=True)
    exponent = torch.rand(scene.density.shape, generator=torch.Generator().manual_seed(0))
    density = factor * 10.0 ** (-5.0 * exponent)
    return replace(scene, density=torch.where(scene.density < 0.6, 0.0, density))


def _single() -> Scene:
    vertices = np.array([[-0.4, -0.3, -0.3], [0.5, -0.2, -0.1], [-0.1, 0.5, -0.2], [0.0, 0.1, 0.6]])
    return make_scene((vertices, np.array([[0, 1, 2, 3]])), random_camera(11), 11, background=True)


def _behind() -> Scene:
    camera = Camera.look_at((0.0, 0.0, 2.0), (0.1, 0.2, 4.0), (0.0, 1.0, 0.0), 1.0, 16, 12)
    return make_scene(delaunay_ball(50, 12), camera, 12, background=True)


def _out_of_view() -> Scene:
    camera = Camera.look_at((0.0, 0.0, 2.0), (8.0, 0.0, 0.0), (0.0, 1.0, 0.0), 0.6, 16, 12)
    return make_scene(delaunay_ball(50, 13), camera, 13, background=True)


def _slabs() -> Scene:
    camera = Camera.look_at((1.3, 0.21, 0.13), (0.0, 0.02, 0.03), (0.1, 0.2, 1.0), 0.8, 24, 24)
    return make_scene(slabs(40), camera, 14, background=True)


def _speck() -> Scene:
    """A mesh that covers about two pixels, with many boundary faces in each."""
    return make_scene(delaunay_ball(200, 15), random_camera(15, 8.0, (8, 8), fov_y=0.5), 15)


SCENES: dict[str, Callable[[], Scene]] = _once(
    {
        "delaunay": _delaunay,
        "grid": _grid,
        "jittered": _jittered,
        "porous": _porous,
        "inside": _inside,
        "in-hole": _in_hole,
        "components": _components,
        "beside": _beside,
        "wide-fov": _wide,
        "off-centre": _off_centre,
        "half-empty": _half_empty,
        "dense-1e2": lambda: _dense(1e2),
        "single": _single,
        "slabs": _slabs,
        "speck": _speck,
        "delaunay-cells": lambda: _delaunay(per_cell=True, background=True),
        "grid-cells": lambda: _grid(per_cell=True),
        "porous-cells": lambda: _porous(per_cell=True, background=True),
        "inside-cells": lambda: _inside(per_cell=True),
        "in-hole-cells": lambda: _in_hole(per_cell=True),
        "components-cells": lambda: _components(per_cell=True),
    }
)
"""Scenes with a smooth enough image for both values and gradients to be compared."""

EXTREME_SCENES: dict[str, Callable[[], Scene]] = _once(
    {
        "empty": _empty,
        "dense-1e4": lambda: _dense(1e4),
        "dense-1e6": lambda: _dense(1e6),
        "behind": _behind,
        "out-of-view": _out_of_view,
        "one-pixel": lambda: make_scene(delaunay_ball(60, 16), random_camera(16, size=(1, 1)), 16),
        "one-row": lambda: make_scene(delaunay_ball(60, 17), random_camera(17, size=(70, 1), fov_y=0.02), 17),
        "one-column": lambda: make_scene(delaunay_ball(60, 18), random_camera(18, size=(1, 70)), 18),
        "over-a-block": lambda: make_scene(delaunay_ball(30, 19), random_camera(19, size=(67, 65)), 19),
    }
)
"""Scenes of which the image is compared, not the gradients."""


def total_error(values: Tensor, reference: Tensor) -> float:
    """Largest absolute difference; infinite if a value is not finite."""
    difference = (values.double() - reference.double()).abs()
    return float(difference.max()) if bool(torch.isfinite(difference).all()) else math.inf


def relative_error(values: Tensor, reference: Tensor) -> float:
    """L2 norm of the difference over that of the reference; infinite if a value is not finite."""
    difference = float((values.double() - reference.double()).norm())
    scale = float(reference.double().norm())
    if not math.isfinite(difference):
        return math.inf
    return difference / scale if scale > 0.0 else difference
