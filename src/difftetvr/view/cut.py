"""A cut through a mesh: what it holds there, and where its cells are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image, ImageDraw

from difftetvr.errors import MeshError, shown
from difftetvr.mesh.field import Field, Location
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.mesh.topology.topology import LOCAL_EDGES
from difftetvr.rendering.scalar_field import ScalarField

_SMOOTHING = 2  # lines are drawn so many times larger, and shrunk
_PIXELS_AT_ONCE = 2_000_000
_LINE_STRENGTH = 0.45
_ASIDE = 1e-6 * 0.7548776662  # planes through vertices are moved by this part of the mesh's size: no cell is cut badly


@dataclass(frozen=True)
class Plane:
    """A plane to cut along.

    Attributes:
        normal: (3,) direction that looks at the viewer, of any length but 0.
        origin: (3,) a point of the plane; the centre of the mesh if None.
    """

    normal: tuple[float, float, float] = (1.0, 0.0, 0.0)
    origin: tuple[float, float, float] | None = None

    def axes(self) -> np.ndarray:
        """(3, 3) unit vectors: to the right and upwards in the picture, and the normal.

        Raises:
            MeshError: The normal is no direction.
        """
        normal = np.asarray(self.normal, dtype=np.float64)
        length = np.linalg.norm(normal)
        if not (np.isfinite(length) and length > 0):
            raise MeshError(f"The normal of the cut is {shown(self.normal)}; pass a direction other than 0.")
        normal = normal / length
        up = np.eye(3)[2 if abs(normal[2]) < 0.9 else 1]
        right = np.cross(up, normal)
        right /= np.linalg.norm(right)
        return np.stack((right, np.cross(normal, right), normal))


@dataclass(frozen=True)
class _Section:
    """Triangles (N, 3, 2) in the plane with values (N, 3, C), and outlines (M, 2, 2) of the cells' sections."""

    triangles: np.ndarray
    values: np.ndarray
    outlines: np.ndarray


@dataclass(frozen=True)
class _Paint:
    """What a cut shows: values (V, C) or (T, C) on a mesh, and the (P, 3) colours of (P, C) interpolated ones."""

    values: np.ndarray
    location: Location
    colors_of: Callable[[np.ndarray], np.ndarray]

    @staticmethod
    def of(mesh: TetMesh, field: Field | ScalarField, background: np.ndarray) -> _Paint:
        if isinstance(field, Field):
            return _Paint(_slab_colors(mesh, field, background), field.location_on(mesh), lambda colors: colors)
        scalars = field.normalised().detach().double().cpu().numpy()[:, None]
        function = field.transfer_function
        return _Paint(scalars, field.location_on(mesh), lambda values: function(values[:, 0])[0])


def cut_picture(
    mesh: TetMesh,
    field: Field | ScalarField,
    plane: Plane | None = None,
    size: int = 512,
    outlines: bool = True,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    within: torch.Tensor | None = None,
) -> Image.Image:
    """Draws a cut through a mesh, and its cells.

    Colours and densities as a slab looks that is a twentieth of the mesh thick; scalars in the colours of their
    transfer function, opaque, of the interpolated scalar in every pixel.

    Args:
        mesh: The mesh.
        field: Its colours and densities, or scalars.
        plane: Where to cut; default: through the centre, seen along x.
        size: Pixels of the picture's longer side.
        outlines: Whether to draw the cells.
        background: R G B behind the slab and beside the mesh.
        within: (2, 3) corners of a box that the picture is cropped to; None: all of the cut is drawn.

    Raises:
        MeshError: The plane misses the mesh or the box, or its normal is no direction.
    """
    plane, paint = plane or Plane(), _Paint.of(mesh, field, np.array(background))
    section = _section(mesh, plane, paint.values, paint.location)
    lower, upper = _cropped(section, mesh, plane, within)
    extent = upper - lower
    scale = (size - 1) / extent.max()
    width, height = (max(1, round(float(side * scale)) + 1) for side in extent)

    def to_pixels(place: np.ndarray) -> np.ndarray:
        place = (place - lower) * scale
        return np.stack((place[..., 0], height - 1 - place[..., 1]), -1)

    blank = np.tile(np.array(background), (height, width, 1))
    pixels = _fill(blank, to_pixels(section.triangles), section.values, paint.colors_of)
    picture = Image.fromarray((255.0 * pixels.clip(0, 1)).round().astype(np.uint8))
    line = (0, 0, 0) if sum(background) > 1.5 else (255, 255, 255)
    return _with_outlines(picture, to_pixels(section.outlines), line) if outlines else picture


def cut_edges(mesh: TetMesh, plane: Plane) -> np.ndarray:
    """Where a plane cuts the cells of a mesh, as line segments.

    Args:
        mesh: The mesh.
        plane: Where to cut.

    Returns:
        (M, 2, 3) float64 ends in world space, of the edges of each cell's section; those between two cells twice.

    Raises:
        MeshError: The plane misses the mesh, or its normal is no direction.
    """
    outlines = _section(mesh, plane, np.zeros((mesh.num_vertices, 1)), "vertex").outlines
    right, up, _ = plane.axes()
    return _origin(mesh, plane) + outlines[..., :1] * right + outlines[..., 1:] * up


def _cropped(
    section: _Section, mesh: TetMesh, plane: Plane, within: torch.Tensor | None
) -> tuple[np.ndarray, np.ndarray]:
    """(2,) lower and (2,) upper corner of what is drawn, in the plane."""
    points = section.outlines.reshape(-1, 2)
    lower, upper = points.min(0), points.max(0)
    if within is None:
        return lower, upper
    right, up, _ = plane.axes()
    corners = np.stack(np.meshgrid(*within.detach().double().cpu().numpy().T, indexing="ij"), -1).reshape(-1, 3)
    places = (corners - _origin(mesh, plane)) @ np.stack((right, up), 1)
    lower, upper = np.maximum(lower, places.min(0)), np.minimum(upper, places.max(0))
    if not (lower < upper).all():
        raise MeshError("The cut misses the box that it is to be cropped to; move its origin.")
    return lower, upper


def _origin(mesh: TetMesh, plane: Plane) -> np.ndarray:
    """(3,) a point of the plane."""
    if plane.origin is not None:
        return np.asarray(plane.origin, dtype=np.float64)
    return mesh.bounds().detach().double().cpu().numpy().mean(0)


def _section(mesh: TetMesh, plane: Plane, values: np.ndarray, location: Location) -> _Section:
    """Where a plane cuts a mesh with values on its vertices or its cells."""
    positions = mesh.vertices.detach().double().cpu().numpy()
    size = float(np.linalg.norm(np.ptp(positions, axis=0)))
    right, up, normal = plane.axes()
    origin = _origin(mesh, plane)
    height = (positions - origin) @ normal + _ASIDE * size
    tets = mesh.tets.cpu().numpy()
    above = height[tets] > 0
    cut = np.flatnonzero(above.any(1) & ~above.all(1))
    if not len(cut):
        raise MeshError(f"The plane at {tuple(origin.tolist())} misses the mesh; move it into the mesh's bounds.")
    per_cell = location == "cell"

    places, shades, owners = [], [], []
    for i, j in LOCAL_EDGES:
        crossed = cut[above[cut, i] != above[cut, j]]
        one, other = tets[crossed, i], tets[crossed, j]
        share = (height[one] / (height[one] - height[other]))[:, None]
        place = (1 - share) * positions[one] + share * positions[other]
        places.append(np.stack(((place - origin) @ right, (place - origin) @ up), 1))
        shades.append(values[crossed] if per_cell else (1 - share) * values[one] + share * values[other])
        owners.append(crossed)
    return _polygons(np.concatenate(places), np.concatenate(shades), np.concatenate(owners))


def _polygons(places: np.ndarray, shades: np.ndarray, owners: np.ndarray) -> _Section:
    """Corners of the cells' sections, three or four a cell, sorted around their centres and cut into triangles."""
    _, cell, counts = np.unique(owners, return_inverse=True, return_counts=True)
    centers = np.stack([np.bincount(cell, column) for column in places.T], 1) / counts[:, None]
    offset = places - centers[cell]
    order = np.lexsort((np.arctan2(offset[:, 1], offset[:, 0]), cell))
    first = np.cumsum(counts) - counts
    three, four = first[counts == 3], first[counts == 4]
    corners = np.concatenate(
        [np.stack([s, s + 1, s + 2], 1) for s in (three, four)] + [np.stack([four, four + 2, four + 3], 1)]
    )
    following = np.arange(len(order)) + 1
    following[np.cumsum(counts) - 1] = first
    places, shades = places[order], shades[order]
    return _Section(places[corners], shades[corners], np.stack((places, places[following]), 1))


def _slab_colors(mesh: TetMesh, field: Field, background: np.ndarray) -> np.ndarray:
    """What a slab of constant colour and density looks like that is a twentieth of the mesh thick."""
    lower, upper = mesh.bounds().detach().double().cpu()
    density, color = field.density.detach().double().cpu(), field.color.detach().double().cpu()
    opacity = -torch.expm1(-density * (upper - lower).norm() / 20.0)[:, None]
    return (color * opacity).numpy() + background * (1.0 - opacity.numpy())


def _fill(
    image: np.ndarray, triangles: np.ndarray, values: np.ndarray, colors_of: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """Draws triangles with linear values, in the colours of these, into an (H, W, 3) image, and returns it."""
    extents = np.ptp(triangles, axis=1).prod(1) + 1.0
    # As many at a time as have some million pixels in their boxes.
    parts = np.flatnonzero(np.diff(np.cumsum(extents) // _PIXELS_AT_ONCE)) + 1
    for some, their_values in zip(np.split(triangles, parts), np.split(values, parts)):
        x, y, inner = _interpolated(image.shape[:2], some, their_values)
        image[y, x] = colors_of(inner)
    return image


def _interpolated(
    shape: tuple[int, ...], triangles: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(P,) columns and (P,) rows of the pixels in triangles, and (P, C) values there."""
    height, width = shape
    low = np.maximum(np.floor(triangles.min(1)).astype(int), 0)
    high = np.minimum(np.ceil(triangles.max(1)).astype(int), (width - 1, height - 1))
    spans = np.maximum(high - low + 1, 0)
    counts = spans.prod(1)
    owner = np.repeat(np.arange(len(triangles)), counts)
    place = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    x = low[owner, 0] + place % spans[owner, 0]
    y = low[owner, 1] + place // spans[owner, 0]
    a, b, c = triangles.transpose(1, 0, 2)
    area = _cross(b - a, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        point = np.stack((x, y), 1) - a[owner]
        second = _cross(point, (c - a)[owner]) / area[owner]
        third = _cross((b - a)[owner], point) / area[owner]
    # A hair more than the triangle, so that no pixel between two neighbours stays black.
    inside = (second >= -1e-9) & (third >= -1e-9) & (second + third <= 1 + 1e-9)
    weights = np.stack((1 - second - third, second, third), 1)[inside]
    return x[inside], y[inside], (weights[:, :, None] * values[owner[inside]]).sum(1)


def _cross(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    return p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]


def _with_outlines(picture: Image.Image, outlines: np.ndarray, color: tuple[int, int, int]) -> Image.Image:
    mask = Image.new("L", (_SMOOTHING * picture.width, _SMOOTHING * picture.height), 0)
    draw = ImageDraw.Draw(mask)
    for start, end in (_SMOOTHING * outlines).tolist():
        draw.line((*start, *end), fill=round(255 * _LINE_STRENGTH))
    mask = mask.resize(picture.size, Image.Resampling.BOX)
    return Image.composite(Image.new("RGB", picture.size, color), picture, mask)
