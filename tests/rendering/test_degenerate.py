"""Rays exactly along edges, through vertices and inside faces: none may be lost, none counted twice.

Nothing rounds in these scenes: camera space has small integer coordinates, and slopes are multiples of powers of two.
Colour and density are constant, so a ray's alpha tells the length that it spent in the mesh, and one cell too few or
too many shows.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from oracle.oracle import pixel_directions
from oracle.scenes import keep_cells, kuhn_grid
from torch import Tensor

from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import render
from difftetvr.rendering.cameras.pinhole import Camera

# float32 rounding of the ray's frame and of a sum over some dozen crossings, at an optical depth of about 1.
TOLERANCE = 1e-5


def make_mesh(vertices: np.ndarray, cells: np.ndarray, dtype: torch.dtype = torch.float32) -> TetMesh:
    return TetMesh(torch.from_numpy(vertices).to(dtype), torch.from_numpy(cells))


def constant_field(mesh: TetMesh, density: float) -> Field:
    ones = torch.ones(mesh.num_vertices, dtype=mesh.vertices.dtype)
    return Field(ones[:, None].expand(-1, 3), density * ones)


def frustum_mesh(side: int, depths: tuple[int, ...], focal: int) -> tuple[np.ndarray, np.ndarray]:
    """A grid whose depth-wise edges all run through the origin, with slopes i / focal and j / focal, exactly."""
    _, cells = kuhn_grid((side, side, len(depths) - 1))
    steps = np.arange(side + 1) - side // 2
    i, j, z = np.meshgrid(steps, steps, np.array(depths, dtype=float), indexing="ij")
    return np.stack([i * z / focal, j * z / focal, z], axis=-1).reshape(-1, 3), cells


def quarter_turn(count: int) -> Tensor:
    """(4, 4) pose of a camera at the origin, rolled about its axis by quarter turns."""
    pose = torch.eye(4)
    c, s = [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)][count]
    pose[:2, :2] = torch.tensor([[c, -s], [s, c]])
    return pose


def axis_rotations() -> list[Tensor]:
    """The 24 rotations that map the axes to the axes, as (3, 3) matrices."""
    rotations = []
    for order, signs in itertools.product(itertools.permutations(range(3)), itertools.product((1.0, -1.0), repeat=3)):
        matrix = torch.zeros(3, 3)
        matrix[range(3), order] = torch.tensor(signs)
        if torch.linalg.det(matrix) > 0:
            rotations.append(matrix)
    return rotations


def lattice_camera(rotation: Tensor, center: tuple[float, float, float], focal: float, pixels: int) -> Camera:
    """A camera with ray slopes k / focal, to which the world's origin lies at ``center``."""
    pose = torch.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, torch.tensor(center)
    middle = pixels // 2 + 0.5
    return Camera(pose, focal, focal, middle, middle, pixels, pixels)


@pytest.mark.parametrize("depths", [(128, 192, 256), (64, 65, 96), (256, 288), (32, 64, 128, 256)])
def test_a_million_rays_along_edges_and_in_faces(depths: tuple[int, ...]) -> None:
    """A quarter of the rays run along edges through all layers, the others inside faces; 1.04 million in all cases."""
    side, focal = 128, 128
    mesh = make_mesh(*frustum_mesh(side, depths, focal))
    field = constant_field(mesh, 1.0 / (depths[-1] - depths[0]))
    pixels = 2 * side + 3  # half a cell apart, with two columns beyond the silhouette on either side
    lost = seen_rays = 0
    for turn in range(4):
        camera = Camera(quarter_turn(turn), 2.0 * focal, 2.0 * focal, pixels / 2, pixels / 2, pixels, pixels)
        alpha = render(mesh, field, camera).alpha.double()
        offset = (torch.arange(pixels) - pixels // 2).abs()
        seen = (offset < side)[:, None] & (offset < side)
        expected = -torch.expm1(-1.0 / pixel_directions(camera)[:, 2].reshape(pixels, pixels))
        lost += int(((alpha - expected).abs()[seen] > TOLERANCE).sum())
        seen_rays += int(seen.sum())
        outside = (offset > side)[:, None] | (offset > side)
        assert float(alpha[outside].max()) == 0.0
    assert lost == 0
    assert seen_rays > 260_000


def box_alpha(camera: Camera, lower: Tensor, upper: Tensor, density: float) -> tuple[Tensor, Tensor]:
    """(H, W) alpha of a box in camera space by slabs, and which rays lie in one of its sides: these may see nothing."""
    directions = pixel_directions(camera)
    parallel = directions == 0
    inside = (lower <= 0) & (upper >= 0)
    first, second = lower / directions, upper / directions
    near = torch.where(parallel, torch.where(inside, -math.inf, math.inf), torch.minimum(first, second))
    far = torch.where(parallel, torch.where(inside, math.inf, -math.inf), torch.maximum(first, second))
    chord = (far.amin(-1) - near.amax(-1).clamp(min=0.0)).clamp(min=0.0)
    in_side = (parallel & ((lower == 0) | (upper == 0))).any(-1)
    size = (camera.height, camera.width)
    return -torch.expm1(-density * chord).reshape(size), in_side.reshape(size)


@pytest.mark.parametrize(
    "center",
    [(0, 0, 24), (3, -5, 16), (0.5, 0.5, 24), (0, 0, 8), (8, 8, 8), (8, 0, 0), (0, 0, 0), (3, -2, 1), (0.5, 1, 0)],
    ids=str,
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_lattice_rays_through_a_box(center: tuple[float, float, float], dtype: torch.dtype) -> None:
    """Rays with slopes k / 16 from lattice points outside, on the surface of and inside a grid, in 24 orientations."""
    side, density = 16, 1.0 / 16.0
    mesh = make_mesh(*kuhn_grid((side, side, side), -8.0, 8.0), dtype)
    field = constant_field(mesh, density)
    middle = torch.tensor(center, dtype=torch.float64)
    wrong = 0
    for rotation in axis_rotations()[:: 1 if dtype == torch.float32 else 6]:
        camera = lattice_camera(rotation, center, 16.0, 65)
        expected, in_side = box_alpha(camera, middle - 8.0, middle + 8.0, density)
        alpha = render(mesh, field, camera).alpha.double()
        nothing = in_side & (alpha.abs() < TOLERANCE)
        wrong += int((((alpha - expected).abs() > TOLERANCE) & ~nothing).sum())
    assert wrong == 0


def kept_lengths(keep: np.ndarray, side: int, eye: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Length of each ray inside the kept cells' interior, and inside their closure.

    A Kuhn grid is the arrangement of the planes x, y, z, x - y, y - z, x - z = integer. Between two of these crossings
    a ray keeps to the same cells, and the points around its middle tell which ones.
    """
    families = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, -1, 0], [0, 1, -1], [1, 0, -1]])
    levels = np.arange(-side, side + 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = ((levels - (families @ eye)[:, None]) / (directions @ families.T)[..., None]).reshape(len(directions), -1)
    t = np.sort(np.where(np.isfinite(t), t, 0.0).clip(0.0, 4.0 * side), axis=1)
    middle, length = 0.5 * (t[:, 1:] + t[:, :-1]), np.diff(t, axis=1)
    nudges = np.random.default_rng(0).normal(size=(48, 3)) * 1e-7
    rank = {order: k for k, order in enumerate(itertools.permutations(range(3)))}
    table = np.full(27, -1)
    for axes, k in rank.items():
        table[axes[0] * 9 + axes[1] * 3 + axes[2]] = k
    ray, piece = np.nonzero(length > 1e-9)
    points = eye + middle[ray, piece, None] * directions[ray]
    least, most = np.ones(len(ray), dtype=bool), np.zeros(len(ray), dtype=bool)
    for nudge in nudges:
        position = points + nudge
        cube = np.floor(position).astype(int)
        inside = ((cube >= 0) & (cube < side)).all(axis=1)
        order = np.argsort(cube - position, axis=1)
        x, y, z = np.clip(cube, 0, side - 1).T
        cell = 6 * ((x * side + y) * side + z) + table[order @ [9, 3, 1]]
        hit = inside & keep[cell]
        least, most = least & hit, most | hit
    scale = np.linalg.norm(directions, axis=1)
    lengths = length[ray, piece] * scale[ray]
    shape = len(directions)
    return np.bincount(ray, lengths * least, minlength=shape), np.bincount(ray, lengths * most, minlength=shape)


@pytest.mark.parametrize("eye", [(4, 4, -8), (3.5, 5, -4), (4, 4, 4), (2, 3, 1), (0, 0, 0), (3, 4.5, 8)], ids=str)
def test_lattice_rays_through_a_mesh_with_holes(eye: tuple[float, float, float]) -> None:
    """Rays that run in the surfaces and along the edges of holes may count them or not; all others must be exact."""
    side, density, pixels = 8, 0.1, 33
    vertices, cells = kuhn_grid((side, side, side), 0.0, float(side))
    rng = np.random.default_rng(3)
    keep = np.repeat(rng.random(side**3) > 0.35, 6) & (rng.random(len(cells)) > 0.1)
    mesh = make_mesh(*keep_cells(vertices, cells, keep))
    field = constant_field(mesh, density)
    ambiguous = 0
    for rotation in axis_rotations()[::7]:
        origin = (-rotation @ torch.tensor(eye, dtype=torch.float32)).tolist()
        camera = lattice_camera(rotation, (origin[0], origin[1], origin[2]), 16.0, pixels)
        alpha = render(mesh, field, camera).alpha.double().ravel()
        directions = (pixel_directions(camera) @ rotation.double()).numpy()
        directions = directions / np.abs(directions).max(axis=1, keepdims=True)  # along an axis: slopes are exact again
        directions = np.round(directions * 2.0**40) / 2.0**40
        least, most = kept_lengths(keep, side, np.array(eye, dtype=float), directions)
        depth = -torch.log1p(-alpha).numpy() / density
        assert (depth > least - 2e-4).all() and (depth < most + 2e-4).all()
        ambiguous += int((most > least + 1e-3).sum())
    assert ambiguous > 20


@pytest.mark.parametrize("center", [(0, 0, 24), (8, 0, 0), (3, -2, 1)], ids=str)
@pytest.mark.parametrize("per_cell", [False, True])
def test_gradients_of_degenerate_rays_are_finite_and_complete(
    center: tuple[float, float, float], per_cell: bool
) -> None:
    """Radiance is homogeneous in colour, so <color, gradient> must give the image back: nothing is lost there, too."""
    mesh = make_mesh(*kuhn_grid((16, 16, 16), -8.0, 8.0))
    vertices = mesh.vertices.clone().requires_grad_()
    count = mesh.num_cells if per_cell else mesh.num_vertices
    color, density = torch.ones(count, 3, requires_grad=True), torch.full((count,), 0.06, requires_grad=True)
    field = Field(color, density, "cell" if per_cell else "vertex")
    camera = lattice_camera(axis_rotations()[5], center, 16.0, 65)
    image = render(mesh.with_vertices(vertices), field, camera)
    loss = image.color.sum() + image.alpha.sum()
    loss.backward()
    assert vertices.grad is not None and color.grad is not None and density.grad is not None
    assert bool(torch.isfinite(vertices.grad).all() and torch.isfinite(density.grad).all())
    assert float(color.grad.double().sum()) == pytest.approx(float(image.color.detach().double().sum()), rel=1e-5)
    # Four transmittances a pixel have the same derivative d/d(log s): sum of tau T, with tau = -log T.
    alpha = image.alpha.detach().double()
    tau = -torch.log1p(-alpha)
    assert 0.06 * float(density.grad.double().sum()) == pytest.approx(
        4.0 * float((tau * (1.0 - alpha)).sum()), rel=1e-4
    )
