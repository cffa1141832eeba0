"""Kernels of the voxel grid: images of it and their adjoint (Dr.Jit).

A ray is sampled at equal steps. Where a sample lies in a cell that holds something, density and coefficients are
interpolated between the cell's eight vertices; density is then cut off at 0, and so is the colour. Cells that hold
nothing know how far the next one is that does, and are passed in one leap.

Densities alone decide which samples are seen. So these are found first, for all rays, and make a list; their colours,
which are most of the work, then take no lanes that have nothing to do, and are computed once for both passes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.backend import Backend

LEAST = 1e-4
"""Transmittance at which a ray ends."""
NONE = 0xFFFFFFFF
"""Where there is no sample."""
EMPTY = 1 << 31
"""Added to the number of cells to the next one that holds something, in the table of cells that hold nothing."""
_FAR = 1e30


@dataclass
class Lattice:
    """Where a grid has vertices, as kernels see it; cells are cubes.

    Attributes:
        backend: Array types.
        size: Number of vertices along x, y and z.
        lower: World position of the first vertex.
        edge: Length of the cells' edges.
        degree: Degree of the spherical harmonics.
        step: Length of a ray's steps, in edges.
        cells: For each cell its number among those that hold something, or `EMPTY` and a distance.
        corners: Rows of the eight vertices of each cell that holds something.
    """

    backend: Backend
    size: tuple[int, int, int]
    lower: tuple[float, float, float]
    edge: float
    degree: int
    step: float
    cells: Any
    corners: Any

    @property
    def width(self) -> int:
        """Floats in a vertex's row."""
        return row_width(self.degree)

    @property
    def density_place(self) -> int:
        """Where in a row the density is, behind the coefficients of red, green and blue."""
        return 3 * (self.degree + 1) ** 2


@dataclass
class Rays:
    """Rays in world space.

    Attributes:
        origin: Where they start, three arrays.
        direction: Unit directions, three arrays.
    """

    origin: list[Any]
    direction: list[Any]


@dataclass
class Samples:
    """Samples that see something, each with the one before it on its ray.

    Attributes:
        place: How far between its cell's vertices each lies, in records of four.
        link: Number of its cell, its ray, the sample before it or `NONE`, and nothing.
        light: Its weight in the ray's colour, and the transmittance behind it.
        count: Number of samples.
        last: The last sample of each ray, or `NONE`.
        through: Transmittance of each ray.
    """

    place: Any
    link: Any
    light: Any
    count: Any
    last: Any
    through: Any


def row_width(degree: int) -> int:
    """Floats in the row of a vertex: whole packets of four, which one instruction moves."""
    return -(-(3 * (degree + 1) ** 2 + 1) // 4) * 4


def harmonics(direction: list[Any], degree: int) -> list[Any]:
    """Real spherical harmonics up to a degree, as Plenoxels and 3-D Gaussian splatting count and sign them."""
    x, y, z = direction
    functions = [type(x)(0.28209479177387814)]
    if degree >= 1:
        functions += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree >= 2:
        functions += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2.0 * z * z - x * x - y * y),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ]
    return functions


class _Place:
    """Where samples lie: in which cells, and how far between the cells' vertices."""

    def __init__(self, lattice: Lattice, position: list[Any]) -> None:
        real, uint = lattice.backend.Float, lattice.backend.UInt
        inside = [dr.fmax(dr.fmin(p, n - 1.001), 0.0) for p, n in zip(position, lattice.size, strict=True)]
        x, y, z = (uint(p) for p in inside)
        self.share = [p - real(i) for p, i in zip(inside, (x, y, z), strict=True)]
        nx, ny, _ = lattice.size
        self.cell = dr.fma(dr.fma(z, ny - 1, y), nx - 1, x)


def _interpolated(values: list[Any], share: list[Any]) -> Any:
    """A value between those of a cell's vertices."""
    for part in share:
        values = [dr.lerp(values[2 * k], values[2 * k + 1], part) for k in range(len(values) // 2)]
    return values[0]


class _Path:
    """The steps of rays through a grid."""

    def __init__(self, lattice: Lattice, density: Any, rays: Rays) -> None:
        self.lattice, self.density = lattice, density
        real, scale = lattice.backend.Float, 1.0 / lattice.edge
        self.origin = [(o - low) * scale for o, low in zip(rays.origin, lattice.lower, strict=True)]
        self.direction = rays.direction
        self.slope = [dr.select(d == 0, real(_FAR), 1.0 / d) for d in self.direction]
        near, far = real(0), real(_FAR)
        for o, s, n in zip(self.origin, self.slope, lattice.size, strict=True):
            first, second = -o * s, (n - 1 - o) * s
            near, far = dr.fmax(near, dr.fmin(first, second)), dr.fmin(far, dr.fmax(first, second))
        self.near = dr.fma(0.5, lattice.step, near)
        self.count = dr.ceil((far - self.near) / lattice.step)

    def place(self, step: Any) -> _Place:
        """Where a ray is after some steps."""
        distance = dr.fma(step, self.lattice.step, self.near)
        return _Place(self.lattice, [dr.fma(d, distance, o) for o, d in zip(self.origin, self.direction, strict=True)])

    def next(self, step: Any) -> tuple[Any, Any]:
        """The next step with a density, from one on, and that density; 0 if there is none."""

        def is_sought(step: Any, density: Any) -> Any:
            return (step < self.count) & (density <= 0.0)

        return dr.while_loop((step, dr.zeros_like(step)), is_sought, lambda step, _: self._look(step))

    def _look(self, step: Any) -> tuple[Any, Any]:
        """The step and its density; or the next that may have one, and 0."""
        place, backend = self.place(step), self.lattice.backend
        entry = dr.gather(backend.UInt, self.lattice.cells, place.cell)
        holds = entry < EMPTY
        packets = [dr.gather(backend.Float4, self.density, dr.fma(entry, 2, k), holds) for k in (0, 1)]
        density = _interpolated([packet[i] for packet in packets for i in range(4)], place.share)
        is_found = holds & (density > 0.0)
        leap = dr.select(holds, 1.0, self._leap(place, backend.Float(entry & (EMPTY - 1))))
        return dr.select(is_found, step, step + leap), dr.select(is_found, density, 0.0)

    def _leap(self, place: _Place, cells: Any) -> Any:
        """Steps to the first sample that may be nearer than so many cells to one that holds something."""
        end = self.lattice.backend.Float(_FAR)
        for d, share, slope in zip(self.direction, place.share, self.slope, strict=True):
            end = dr.fmin(end, dr.abs((dr.select(d > 0.0, cells, 1.0 - cells) - share) * slope))
        return dr.fmax(dr.ceil(end / self.lattice.step), 1.0)


def find_samples(lattice: Lattice, density: Any, rays: Rays, capacity: int) -> Samples:
    """The samples of rays that see something, for :func:`difftetvr.recording.replayed`.

    Args:
        lattice: Where vertices are.
        density: The densities of the eight vertices of each cell that holds something.
        rays: The rays.
        capacity: Number of samples for which there is room; those beyond it are counted, but left out.
    """
    path, real, uint = _Path(lattice, density, rays), lattice.backend.Float, lattice.backend.UInt
    place, link = dr.empty(real, 4 * capacity), dr.empty(uint, 4 * capacity)
    light, count = dr.empty(real, 2 * capacity), dr.zeros(uint, 1)
    ray = dr.arange(uint, dr.width(path.count))

    def goes_on(step: Any, through: Any, last: Any) -> Any:
        return (step < path.count) & (through > LEAST)

    def body(step: Any, through: Any, last: Any) -> tuple[Any, ...]:
        step, density = path.next(step)
        is_seen = density > 0.0
        slot = dr.scatter_inc(count, uint(0), is_seen)
        is_kept = is_seen & (slot < capacity)
        weight = through * (1.0 - dr.exp(-density * (lattice.step * lattice.edge)))
        through = through - weight
        where = path.place(step)
        number = dr.gather(uint, lattice.cells, where.cell, is_kept)
        dr.scatter(place, lattice.backend.Float4(*where.share, 0.0), slot, is_kept)
        dr.scatter(link, lattice.backend.UInt4(number, ray, last, 0), slot, is_kept)
        dr.scatter(light, lattice.backend.Float2(weight, through), slot, is_kept)
        return step + 1.0, through, dr.select(is_kept, slot, last)

    lanes = dr.width(path.count)
    begin = (dr.zeros(real, lanes), dr.ones(real, lanes), dr.full(uint, NONE, lanes))
    _, through, last = dr.while_loop(begin, goes_on, body)
    dr.eval(place, link, light, count, through, last)
    return Samples(place, link, light, count, last, through)


class _Seen:
    """Samples with the vertices around them."""

    def __init__(self, lattice: Lattice, samples: Samples, direction: list[Any], lane: Any) -> None:
        backend = lattice.backend
        self.lattice = lattice
        self.active = lane < samples.count
        self.lane = lane
        link = dr.gather(backend.UInt4, samples.link, lane, self.active)  # beyond the last, zeros: a row that exists
        share = dr.gather(backend.Float4, samples.place, lane, self.active)
        self.number, self.share = link[0], [share[k] for k in range(3)]
        self.basis = harmonics([dr.gather(backend.Float, d, link[1]) for d in direction], lattice.degree)

    def at_vertices(self, visit: Callable[..., tuple[Any, ...]], state: tuple[Any, ...]) -> tuple[Any, ...]:
        """Visit the vertices with their rows and weights; a loop, as code for all eight would need too many registers.

        Args:
            visit: Takes row, weight and state; returns the new state.
            state: Arrays.
        """

        def body(corner: Any, *state: Any) -> tuple[Any, ...]:
            row = dr.gather(self.lattice.backend.UInt, self.lattice.corners, dr.fma(self.number, 8, corner))
            weight = self.lattice.backend.Float(1)
            for axis, share in enumerate(self.share):
                weight *= dr.select((corner & (1 << axis)) != 0, share, 1.0 - share)
            return (corner + 1, *visit(row, weight, *state))

        begin = dr.zeros(self.lattice.backend.UInt, dr.width(self.lane))
        return dr.while_loop((begin, *state), lambda corner, *_: corner < 8, body)[1:]

    def color(self, rows: Any) -> list[Any]:
        """Colours, before they are cut off at 0."""
        backend, packets, terms = self.lattice.backend, self.lattice.width // 4, len(self.basis)

        def visit(row: Any, weight: Any, *color: Any) -> tuple[Any, ...]:
            parts = [dr.gather(backend.Float4, rows, dr.fma(row, packets, k)) for k in range(packets)]
            values, total = [part[i] for part in parts for i in range(4)], []
            for c in range(3):
                seen = values[c * terms] * self.basis[0]
                for k in range(1, terms):
                    seen = dr.fma(values[c * terms + k], self.basis[k], seen)
                total.append(dr.fma(weight, seen, color[c]))
            return tuple(total)

        return list(self.at_vertices(visit, tuple(dr.full(backend.Float, 0.5, dr.width(self.lane)) for _ in range(3))))

    def add(self, sums: Any, adjoint: Any) -> None:
        """Add to the rows of the vertices.

        Two threads that add to one value in the same moment may lose one of the two, which happens rarely enough to
        leave the optimiser unmoved; atomic additions take three times as long.
        """
        backend = self.lattice.backend
        record = [adjoint[c] * b for c in range(3) for b in self.basis] + [adjoint[3]]
        record += [backend.Float(0)] * (self.lattice.width - len(record))

        def visit(row: Any, weight: Any) -> tuple[Any, ...]:
            part = backend.Floats([weight * value for value in record])
            dr.scatter_add(sums, part, row, self.active, mode=dr.ReduceMode.NoConflicts)
            return ()

        self.at_vertices(visit, ())


def color_samples(lattice: Lattice, rows: Any, samples: Samples, direction: list[Any], lane: Any) -> Any:
    """The colours of samples in records of four, for :func:`difftetvr.recording.replayed`.

    Args:
        lattice: Where vertices are.
        rows: What they hold.
        samples: The samples.
        direction: The directions of the rays.
        lane: Numbers of as many samples or more.
    """
    seen = _Seen(lattice, samples, direction, lane)
    colors = dr.empty(lattice.backend.Float, dr.width(samples.place))
    dr.scatter(colors, lattice.backend.Float4(*seen.color(rows), 0.0), lane, seen.active)
    dr.eval(colors)
    return colors


def _gathered(lattice: Lattice, samples: Samples, colors: Any, slot: Any) -> tuple[Any, Any, Any]:
    """Weight and transmittance behind a sample, its colour, and the sample before it."""
    backend = lattice.backend
    light = dr.gather(backend.Float2, samples.light, slot)
    return light, dr.gather(backend.Float4, colors, slot), dr.gather(backend.UInt, samples.link, dr.fma(slot, 4, 2))


def compose(lattice: Lattice, samples: Samples, colors: Any, background: list[Any]) -> list[Any]:
    """Colours of rays, three arrays, for :func:`difftetvr.recording.replayed`."""

    def body(slot: Any, *total: Any) -> tuple[Any, ...]:
        light, color, slot = _gathered(lattice, samples, colors, slot)
        return (slot, *(dr.fma(light[0], dr.fmax(color[c], 0.0), total[c]) for c in range(3)))

    begin = (samples.last, *(samples.through * b for b in background))
    _, *total = dr.while_loop(begin, lambda slot, *_: slot != NONE, body)
    dr.eval(total)
    return total


def adjoint_of_samples(
    lattice: Lattice, samples: Samples, colors: Any, background: list[Any], wanted: list[Any]
) -> Any:
    """Derivatives by the samples' colours and densities in records of four, for `difftetvr.recording.replayed`.

    The samples of a ray are passed from the last to the first; what lies behind one is what has been passed.

    Args:
        lattice, samples, colors, background: As for :func:`compose`.
        wanted: Derivatives of the loss by the colours of rays, three arrays.
    """
    backend, length = lattice.backend, lattice.step * lattice.edge
    result = dr.empty(backend.Float, dr.width(samples.place))

    def body(slot: Any, behind: Any) -> tuple[Any, Any]:
        light, color, before = _gathered(lattice, samples, colors, slot)
        seen = sum(dr.fmax(color[c], 0.0) * wanted[c] for c in range(3))
        by_color = [dr.select(color[c] > 0.0, light[0] * wanted[c], 0.0) for c in range(3)]
        by_density = length * dr.fma(light[1], seen, -behind)
        dr.scatter(result, backend.Float4(*by_color, by_density), slot)
        return before, dr.fma(light[0], seen, behind)

    begin = (samples.last, samples.through * sum(b * w for b, w in zip(background, wanted, strict=True)))
    dr.while_loop(begin, lambda slot, _: slot != NONE, body)
    dr.eval(result)
    return result


def add_to_sums(lattice: Lattice, samples: Samples, direction: list[Any], adjoint: Any, lane: Any, sums: Any) -> None:
    """Add derivatives by samples to those by rows.

    Args:
        lattice, samples, direction, lane: As for :func:`color_samples`.
        adjoint: The derivatives by samples.
        sums: What to add to, as many floats as there are in all rows.
    """
    seen = _Seen(lattice, samples, direction, lane)
    seen.add(sums, dr.gather(lattice.backend.Float4, adjoint, lane, seen.active))
