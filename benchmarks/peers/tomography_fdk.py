"""Filtered backprojection: Feldkamp's for a source on a circle around z, and that of parallel rays (Dr.Jit, torch.fft).

Source: Feldkamp, Davis and Kress, "Practical cone-beam algorithm", J. Opt. Soc. Am. A 1 (1984).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch
from tomography_scan import VoxelScan

from difftetvr.backend import get_backend
from difftetvr.capture import ProjectionGeometry
from difftetvr.errors import CaptureError

_NUMBERS = 12  # of a view: pixel coordinates and depth are ratios of affine functions of the place
_EQUAL = 1e-6


@dataclass(frozen=True)
class Feldkamp:
    """Options.

    Attributes:
        cutoff: Frequency at which Hann's window ends, in units of the greatest that the pixels tell.
    """

    cutoff: float = 0.3


@dataclass(frozen=True)
class _Views:
    """What backprojection needs to know of V views.

    Attributes:
        cosine: (V, H, W) of the angle between each ray and its view's middle one; a number if it is one for all.
        weight: (V,) of filtered projections for pixels of size 1.
        table: (V, 12) see `_table`.
    """

    cosine: torch.Tensor | float
    weight: torch.Tensor
    table: torch.Tensor


def feldkamp(scan: VoxelScan, size: int, options: Feldkamp) -> torch.Tensor:
    """(N^3) densities of the training views, at least 0."""
    geometry = scan.geometry.select(scan.train)
    views = _parallel_views(geometry) if geometry.detector.source is None else _cone_views(geometry)
    height, width = geometry.shape[1:]
    values = scan.measured[scan.train].reshape(-1, height, width).double() * views.cosine
    values = _filtered(values, options.cutoff) * views.weight[:, None, None]
    lower, upper = geometry.bounds
    sides = (upper - lower) / size
    # From places in the world to numbers of voxels.
    table = views.table.reshape(-1, 3, 4)
    table[..., 3] += table[..., :3] @ (lower + 0.5 * sides)
    table[..., :3] *= sides
    return _backprojected(values.float(), table.reshape(-1, _NUMBERS).float(), size).clamp_min_(0.0)


def _of_each_view(geometry: ProjectionGeometry, rays: torch.Tensor) -> list[torch.Tensor]:
    """(V, 3) centres of detectors, sources or directions of rays, and steps along columns and rows."""
    detector = geometry.detector
    return [part.expand(geometry.num_views, 3) for part in (detector.center, rays, detector.columns, detector.rows)]


def _cone_views(geometry: ProjectionGeometry) -> _Views:
    detector = geometry.detector
    assert detector.source is not None
    center, source, columns, rows = _of_each_view(geometry, detector.source)
    height, width = geometry.shape[1:]
    radius, distance = source[:, :2].norm(dim=1), (center - source).norm(dim=1)
    if float(radius.max() - radius.min()) > _EQUAL * float(radius.max()):
        raise CaptureError("The sources stand on no circle around the z axis, so Feldkamp's method does not apply.")
    across, down = columns.norm(dim=1), rows.norm(dim=1)
    x = (torch.arange(width) + 0.5 - 0.5 * width).double()
    y = (torch.arange(height) + 0.5 - 0.5 * height).double()
    place = center[:, None, None] + x[:, None] * columns[:, None, None] + y[:, None, None] * rows[:, None, None]
    cosine = distance[:, None, None] / (place - source[:, None, None]).norm(dim=-1)
    step = across * radius / distance  # of the pixels where they are seen on the axis
    weight = 0.5 * _gaps(torch.atan2(source[:, 1], source[:, 0]), 2.0 * math.pi) * radius**2 / step
    table = _table(center, source, columns / across[:, None] ** 2, rows / down[:, None] ** 2, (height, width))
    return _Views(cosine, weight, table)


def _parallel_views(geometry: ProjectionGeometry) -> _Views:
    """Half a turn sees all there is to see, and what is far is seen as large as what is near."""
    detector = geometry.detector
    assert detector.direction is not None
    center, direction, columns, rows = _of_each_view(geometry, detector.direction)
    across, down = columns.norm(dim=1, keepdim=True), rows.norm(dim=1, keepdim=True)
    unit, normal = direction / direction.norm(dim=1, keepdim=True), torch.linalg.cross(columns, rows)
    skew = torch.linalg.cross(unit, normal / normal.norm(dim=1, keepdim=True))
    if max(float(part.abs().max()) for part in (unit[:, 2], columns[:, 2] / across[:, 0], skew)) > _EQUAL:
        raise CaptureError("The parallel rays do not run across z and an upright detector; backprojection needs that.")
    numbers = torch.zeros(geometry.num_views, 3, 4, dtype=torch.float64)
    for k, (along, pixels) in enumerate(((columns / across**2, detector.width), (rows / down**2, detector.height))):
        numbers[:, k, :3] = along
        numbers[:, k, 3] = 0.5 * pixels - 0.5 - (center * along).sum(1)
    numbers[:, 2, 3] = 1.0
    weight = _gaps(torch.atan2(direction[:, 1], direction[:, 0]), math.pi) / across[:, 0]
    return _Views(1.0, weight, numbers.reshape(-1, _NUMBERS))


def _gaps(angles: torch.Tensor, turn: float) -> torch.Tensor:
    """(V,) half the angles between each view's neighbours, for views all around a turn after which all repeats."""
    angles = torch.remainder(angles, turn)
    order = torch.argsort(angles)
    sorted_angles = angles[order]
    after = torch.remainder(sorted_angles.roll(-1) - sorted_angles, turn)
    gaps = torch.empty_like(angles)
    gaps[order] = 0.5 * (after + after.roll(1))
    return gaps


def _filtered(values: torch.Tensor, cutoff: float) -> torch.Tensor:
    """Rows after the ramp for pixels of size 1, which is exact in space, and Hann's window."""
    width = values.shape[-1]
    length = 1 << (2 * width - 1).bit_length()
    place = torch.arange(length)
    place = torch.minimum(place, length - place).double()
    ramp = torch.where(place % 2 == 1, -1.0 / (math.pi * place.clamp_min(1.0)) ** 2, 0.0)
    ramp[0] = 0.25
    share = torch.fft.rfftfreq(length, dtype=torch.float64) / (0.5 * cutoff)
    window = torch.where(share < 1.0, 0.5 + 0.5 * torch.cos(math.pi * share), 0.0)
    spectrum = torch.fft.rfft(ramp).real * window
    return torch.fft.irfft(torch.fft.rfft(values, n=length) * spectrum, n=length)[..., :width]


def _table(
    center: torch.Tensor, source: torch.Tensor, columns: torch.Tensor, rows: torch.Tensor, shape: tuple[int, int]
) -> torch.Tensor:
    """(V, 12) coefficients: column times depth, row times depth, depth, each of x, y, z and 1.

    ``columns`` and ``rows`` are divided by their squared lengths; pixel (0, 0) has its middle at (0, 0).
    """
    normal = torch.linalg.cross(columns, rows)
    normal = normal / normal.norm(dim=1, keepdim=True)
    depth = ((center - source) * normal).sum(1)
    normal, depth = normal * depth.sign()[:, None], depth.abs()
    result = []
    for along, pixels in ((columns, shape[1]), (rows, shape[0])):
        first = 0.5 * pixels - 0.5 - ((center - source) * along).sum(1)
        linear = depth[:, None] * along + first[:, None] * normal
        result.append(torch.cat((linear, -(linear * source).sum(1, keepdim=True)), 1))
    result.append(torch.cat((normal, -(normal * source).sum(1, keepdim=True)), 1))
    return torch.cat(result, 1)


def _backprojected(values: torch.Tensor, table: torch.Tensor, size: int) -> torch.Tensor:
    """(N^3) sums over views of their values where a voxel's middle is seen, over the square of its depth."""
    b = get_backend("cpu")
    views, height, width = values.shape
    with b.exclusive():
        lane = dr.arange(b.UInt, size**3)
        side, wide, area = b.opaque_uint(size), b.opaque_uint(width), b.opaque_uint(width * height)
        ends = (b.opaque(width - 1.0), b.opaque(height - 1.0))
        count, pixels, numbers = b.opaque_uint(views), b.floats(values), b.floats(table)
        line = lane // side
        place = [b.Float(lane - line * side), b.Float(line % side), b.Float(line // side)]

        def add(view: Any, total: Any) -> tuple[Any, Any]:
            found = []
            for k in range(3):
                c = [dr.gather(b.Float, numbers, view * _NUMBERS + 4 * k + i) for i in range(4)]
                found.append(dr.fma(c[0], place[0], dr.fma(c[1], place[1], dr.fma(c[2], place[2], c[3]))))
            inverse = 1.0 / found[2]
            x, y = found[0] * inverse, found[1] * inverse
            seen = (x >= 0.0) & (x <= ends[0]) & (y >= 0.0) & (y <= ends[1])
            left, top = (dr.fmin(dr.floor(v), e - 1.0) for v, e in zip((x, y), ends))
            first = view * area + b.UInt(top) * wide + b.UInt(left)
            upper, lower = (
                dr.lerp(dr.gather(b.Float, pixels, at, seen), dr.gather(b.Float, pixels, at + 1, seen), x - left)
                for at in (first, first + wide)
            )
            return view + 1, dr.fma(dr.lerp(upper, lower, y - top), inverse * inverse, total)

        state = (dr.zeros(b.UInt, size**3), b.Float(0))
        return b.tensor(dr.while_loop(state, lambda view, _: view < count, add)[1])
