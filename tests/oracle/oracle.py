"""The reference that every renderer is held against: float64, brute force, quadrature of the integral itself.

Nothing here is shared with the renderers. Every ray is intersected with every cell by half-spaces (no adjacency, no
walk), the intervals are sorted by distance, and the emission-absorption integral

    radiance = int c(t) sigma(t) T(t) dt,    T(t) = exp(-int_0^t sigma),    t = distance from the camera

is evaluated by composite Gauss-Legendre quadrature inside each cell. Colour and density are linear inside a cell, so
the integrand is smooth there and the quadrature converges to rounding error. Everything is ordinary PyTorch, hence
differentiable in vertices, colours, densities, pose and background.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from difftetvr.rendering.cameras.pinhole import Camera

NODES_PER_PANEL = 14
# With 14 nodes the error of a panel over which the optical depth grows by 8 is below 1e-16.
DEPTH_PER_PANEL = 8.0
RAYS_TIMES_CELLS_PER_CHUNK = 1_000_000
OPPOSITE_FACES = torch.tensor([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])


@dataclass(frozen=True)
class OracleImage:
    """What a renderer has to return, in float64.

    Attributes:
        color: (H, W, 3) premultiplied radiance over the background.
        alpha: (H, W) 1 - transmittance of the whole ray.
        depth: (H, W) expected distance from the camera, ``int t sigma T dt / alpha``; 0 where alpha is 0.
        crossings: (H, W) number of cells that each ray crosses over a positive length.
    """

    color: Tensor
    alpha: Tensor
    depth: Tensor
    crossings: Tensor


@dataclass(frozen=True)
class Crossings:
    """The pairs of a ray and a cell that meet over a positive length, sorted by ray and then by distance.

    Attributes:
        ray: (P,) index of the ray.
        cell: (P,) index of the cell.
        enter: (P,) local index of the face through which the ray enters the cell.
        leave: (P,) local index of the face through which the ray leaves the cell.
        rank: (P,) position of the crossing along its ray, from 0.
    """

    ray: Tensor
    cell: Tensor
    enter: Tensor
    leave: Tensor
    rank: Tensor


def render_oracle(
    vertices: Tensor,
    tets: Tensor,
    color: Tensor,
    density: Tensor,
    camera: Camera,
    background: Tensor | None = None,
    per_cell: bool = False,
    nudge: tuple[float, float] = (0.0, 0.0),
    color_per_cell: bool = False,
) -> OracleImage:
    """Render by brute force in float64.

    A ray that lies exactly inside a face belongs to both its cells here; ``nudge`` moves such rays off.

    Args:
        vertices: (V, 3) world-space positions.
        tets: (T, 4) vertex indices, any orientation.
        color: (V, 3), or (T, 3) if ``per_cell``.
        density: (V,), or (T,) if ``per_cell``.
        camera: The camera; its extrinsics may require grad.
        background: (3,) radiance behind the mesh, black if None.
        per_cell: Whether colour and density are constant in each cell.
        nudge: Offset added to the x and y components of all ray directions at z = 1.
        color_per_cell: Whether colour alone is constant in each cell.
    """
    pose = camera.world_to_camera.to(torch.float64)
    points = vertices.to(torch.float64) @ pose[:3, :3].T + pose[:3, 3]
    directions = pixel_directions(camera, nudge)
    offset, slope = barycentric_functions(points[tets.long()])
    crossings = find_crossings(offset.detach(), slope.detach(), directions)
    shape = (camera.height, camera.width)
    colors = _cell_values(tets, color, per_cell or color_per_cell)
    values = torch.cat([colors, _cell_values(tets, density[:, None], per_cell)], dim=-1)
    return _integrate(offset, slope, directions, crossings, values, background, shape)


def optical_depths_oracle(
    vertices: Tensor, tets: Tensor, density: Tensor, camera: Camera, distances: Tensor, per_cell: bool = False
) -> Tensor:
    """Optical depths from the camera to distances along its rays: sums over all cells that lie before them.

    Args:
        vertices: (V, 3) world-space positions.
        tets: (T, 4) vertex indices, any orientation.
        density: (V,), or (T,) if ``per_cell``.
        camera: The camera; its extrinsics may require grad.
        distances: (H, W, K) or (K,); may require grad.
        per_cell: Whether the density is constant in each cell.

    Returns:
        (H, W, K) in float64.
    """
    pose = camera.world_to_camera.to(torch.float64)
    points = vertices.to(torch.float64) @ pose[:3, :3].T + pose[:3, 3]
    directions = pixel_directions(camera)
    offset, slope = barycentric_functions(points[tets.long()])
    crossings = find_crossings(offset.detach(), slope.detach(), directions)
    t_in, t_out, rate = _spans(offset, slope, directions, crossings)
    values = _cell_values(tets, density[:, None], per_cell)[crossings.cell, :, 0]
    at_entry = ((offset[crossings.cell] + rate * t_in[:, None]) * values).sum(1)
    rise = (rate * values).sum(1)
    ends = torch.broadcast_to(distances.to(torch.float64), (camera.height, camera.width, distances.shape[-1]))
    ends = ends.reshape(-1, ends.shape[-1])
    length = (torch.minimum(ends[crossings.ray], t_out[:, None]) - t_in[:, None]).clamp(min=0.0)
    parts = length * (at_entry[:, None] + 0.5 * rise[:, None] * length)
    total = torch.zeros_like(ends).index_add(0, crossings.ray, parts)
    return total.reshape(camera.height, camera.width, -1)


def pixel_directions(camera: Camera, nudge: tuple[float, float] = (0.0, 0.0)) -> Tensor:
    """(H * W, 3) unit directions through the pixels' centres in camera space, row by row."""
    x = (torch.arange(camera.width, dtype=torch.float64) + 0.5 - camera.cx) / camera.fx + nudge[0]
    y = (torch.arange(camera.height, dtype=torch.float64) + 0.5 - camera.cy) / camera.fy + nudge[1]
    directions = torch.stack([x.repeat(camera.height), y.repeat_interleave(camera.width)], dim=-1)
    directions = torch.cat([directions, torch.ones_like(directions[:, :1])], dim=-1)
    return directions / directions.norm(dim=-1, keepdim=True)


def barycentric_functions(corners: Tensor) -> tuple[Tensor, Tensor]:
    """Barycentric coordinates as affine functions of position, ``lambda_k(x) = offset_k + slope_k . x``.

    Args:
        corners: (T, 4, 3) vertices of the cells.

    Returns:
        offset (T, 4) and slope (T, 4, 3).
    """
    face = corners[:, OPPOSITE_FACES]
    normal = torch.linalg.cross(face[:, :, 1] - face[:, :, 0], face[:, :, 2] - face[:, :, 0])
    height = (normal * (corners - face[:, :, 0])).sum(-1)
    slope = normal / height[..., None]
    return -(slope * face[:, :, 0]).sum(-1), slope


def find_crossings(offset: Tensor, slope: Tensor, directions: Tensor) -> Crossings:
    """All pairs of rays from the origin and cells that meet in front of the camera over a positive length."""
    found = []
    rays_per_chunk = max(1, RAYS_TIMES_CELLS_PER_CHUNK // len(offset))
    with torch.no_grad():
        for start in range(0, len(directions), rays_per_chunk):
            rays = directions[start : start + rays_per_chunk]
            rate = torch.einsum("rj,tkj->rtk", rays, slope)
            distance = -offset / rate
            # A face parallel to the ray bounds it nowhere (if the ray is inside) or everywhere (if it is outside).
            parallel = rate == 0
            nowhere = torch.where(offset >= 0, math.inf, -math.inf).expand_as(rate)
            t_in, enter = distance.masked_fill(rate <= 0, -math.inf).max(dim=-1)
            t_out, leave = torch.where(parallel, nowhere, distance.masked_fill(rate > 0, math.inf)).min(dim=-1)
            ray, cell = torch.nonzero(t_out > t_in.clamp(min=0.0), as_tuple=True)
            middle = 0.5 * (t_in.clamp(min=0.0) + t_out)[ray, cell]
            found.append((ray + start, cell, enter[ray, cell], leave[ray, cell], middle))
    ray, cell, enter, leave, middle = (torch.cat(column) for column in zip(*found, strict=True))
    order = torch.from_numpy(np.lexsort((middle.numpy(), ray.numpy())))
    ray, cell, enter, leave = ray[order], cell[order], enter[order], leave[order]
    first = torch.searchsorted(ray, ray)
    return Crossings(ray, cell, enter, leave, torch.arange(len(ray)) - first)


def quadrature(optical_depth: float) -> tuple[Tensor, Tensor]:
    """Composite Gauss-Legendre nodes and weights on [0, 1] for a cell of at most the given optical depth.

    The panels halve towards the entry, where a dense cell's transmittance falls off; behind it there is nothing left
    to integrate, so long panels do no harm.
    """
    panels = 1 + max(0, math.ceil(math.log2(max(optical_depth, 1e-300) / DEPTH_PER_PANEL)) + 1)
    # A density that grows from zero falls off like exp(-depth x^2), which the same panels resolve.
    ends = np.concatenate([[0.0], 2.0 ** np.arange(1 - panels, 1)])
    x, w = np.polynomial.legendre.leggauss(NODES_PER_PANEL)
    lengths = np.diff(ends)[:, None]
    nodes = ends[:-1, None] + lengths * (0.5 * x + 0.5)
    return torch.from_numpy(nodes.ravel()), torch.from_numpy((lengths * 0.5 * w).ravel())


def _cell_values(tets: Tensor, values: Tensor, per_cell: bool) -> Tensor:
    """(T, 4, C) values at the four corners of each cell."""
    exact = values.to(torch.float64)
    return exact[:, None].expand(-1, 4, -1) if per_cell else exact[tets.long()]


def _spans(offset: Tensor, slope: Tensor, directions: Tensor, crossings: Crossings) -> tuple[Tensor, Tensor, Tensor]:
    """(P,) distances where crossings begin and end, and (P, 4) slopes of the barycentric coordinates along the rays."""
    rate = (slope[crossings.cell] * directions[crossings.ray, None]).sum(-1)

    def distance_to(face: Tensor) -> Tensor:
        column = face[:, None]
        return (-offset[crossings.cell].gather(1, column) / rate.gather(1, column)).squeeze(1)

    return distance_to(crossings.enter).clamp(min=0.0), distance_to(crossings.leave), rate


def _integrate(
    offset: Tensor,
    slope: Tensor,
    directions: Tensor,
    crossings: Crossings,
    values: Tensor,
    background: Tensor | None,
    shape: tuple[int, int],
) -> OracleImage:
    ray, cell = crossings.ray, crossings.cell
    t_in, t_out, rate = _spans(offset, slope, directions, crossings)
    length = t_out - t_in
    at_entry = ((offset[cell] + rate * t_in[:, None])[..., None] * values[cell]).sum(1)
    change = ((rate * length[:, None])[..., None] * values[cell]).sum(1)

    cell_depth = length * (at_entry[:, 3] + 0.5 * change[:, 3])
    pixels = len(directions)
    table = torch.zeros(pixels, int(crossings.rank.max()) + 1 if len(ray) else 1, dtype=torch.float64)
    table = table.index_put((ray, crossings.rank), cell_depth)
    depth_before = (table.cumsum(dim=1) - table)[ray, crossings.rank]

    x, w = quadrature(float(cell_depth.detach().max()) if len(ray) else 0.0)
    density = at_entry[:, 3:] + change[:, 3:] * x
    depth_to_node = length[:, None] * (at_entry[:, 3:] * x + 0.5 * change[:, 3:] * x * x)
    weight = torch.exp(-depth_before[:, None] - depth_to_node) * density * length[:, None] * w
    emitted = (weight[..., None] * (at_entry[:, None, :3] + change[:, None, :3] * x[:, None])).sum(1)
    moment = (weight * (t_in[:, None] + length[:, None] * x)).sum(1)

    radiance = torch.zeros(pixels, 3, dtype=torch.float64).index_add(0, ray, emitted)
    optical_depth = table.sum(dim=1)
    alpha = -torch.expm1(-optical_depth)
    visible = alpha > 0
    total_moment = torch.zeros(pixels, dtype=torch.float64).index_add(0, ray, moment)
    expected = torch.where(visible, total_moment / torch.where(visible, alpha, 1.0), 0.0)
    if background is not None:
        radiance = radiance + torch.exp(-optical_depth)[:, None] * background.to(torch.float64)
    count = torch.bincount(ray, minlength=pixels)
    return OracleImage(radiance.reshape(*shape, 3), alpha.reshape(shape), expected.reshape(shape), count.reshape(shape))
