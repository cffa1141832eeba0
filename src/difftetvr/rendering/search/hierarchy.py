"""A hierarchy of boxes over faces or cells: which of them may a line or a point meet? (Dr.Jit and PyTorch)

The items are sorted along a Morton curve (Lauterbach et al. 2009, "Fast BVH construction on GPUs") and are the leaves
of a complete binary tree: node n has the children 2 n and 2 n + 1, so there are no pointers, and a traversal needs no
stack, for what follows node n in depth-first order is n + 1 without its trailing zero bits. The order matters for speed
alone; it is kept with the mesh's topology, and positions that move only change the boxes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.backend import Backend
from difftetvr.mesh.arrays import chunks
from difftetvr.mesh.topology.topology import Topology
from difftetvr.rendering.search.beams import Beam, Triple
from difftetvr.rendering.search.scene import Cells
from difftetvr.rendering.traversal.rays import largest_coordinate, rounding_of

CELLS_OF_A_LEAF = 2
"""Searches among cells are slower with one or with four."""

_CURVE_BITS = 20  # of each coordinate

_BLOCK_LEVELS = 2
"""Levels above the leaves at which pencils of rays stop: they try four items at a time."""

_LEVELS = 3
"""Levels of a hierarchy that a kernel makes of the one below them."""


@dataclass(frozen=True)
class SortedItems:
    """Items of a hierarchy along a curve through space.

    Attributes:
        items: (N,) int32 their numbers.
        corners: (N, K) int32 their vertices.
    """

    items: torch.Tensor
    corners: torch.Tensor

    @staticmethod
    def of(items: torch.Tensor, corners: torch.Tensor, vertices: torch.Tensor) -> SortedItems:
        """Sort (N,) items with (N, K) corners by where their centres lie among (V, 3) vertices."""
        order = curve_order(_centers(vertices, corners))
        return SortedItems(items[order].to(torch.int32), corners[order].to(torch.int32))


@dataclass
class Leaves:
    """Items of a hierarchy as kernels of any precision read them, wherever they are.

    Attributes:
        items: (N,) numbers of the items, those of a leaf next to each other.
        corners: Flat (N, K) vertices.
        width: K.
        count: N, as a device value.
        leaf_items: How many items a leaf has.
        level: Binary logarithm of the number L of leaves.
        leaf: (L,) numbers of the leaves, of which the last may have no items.
        above: Numbers of the nodes of each level above the leaves for which there is a kernel.
        first: L, as a device value.
    """

    items: Any
    corners: Any
    width: int
    count: Any
    leaf_items: int
    level: int
    leaf: Any
    above: list[Any]
    first: Any

    @staticmethod
    def of(backend: Backend, sorted_items: SortedItems, leaf_items: int) -> Leaves:
        """Upload items, so many for each leaf: one for speed, several for less memory."""
        count, width = sorted_items.corners.shape
        level = max(0, -(-count // leaf_items) - 1).bit_length()
        return Leaves(
            backend.uints(sorted_items.items),
            backend.uints(sorted_items.corners),
            width,
            backend.constant(count),
            leaf_items,
            level,
            backend.lanes(1 << level),
            [backend.lanes(1 << above) for above in _levels_above(level)],
            backend.constant(1 << level),
        )


def _levels_above(level: int) -> list[int]:
    """Levels at which kernels start that make boxes, from below: each makes its own and those on the way there."""
    return [max(above, 0) for above in range(level - _LEVELS, -_LEVELS, -_LEVELS)]


def leaves_of_cells(backend: Backend, topology: Topology, vertices: Callable[[], torch.Tensor]) -> Leaves:
    """All cells of a mesh, sorted by where they are among (V, 3) vertices the first time."""

    def build() -> Leaves:
        cells = torch.arange(topology.num_cells, device=topology.tets.device)
        return Leaves.of(backend, SortedItems.of(cells, topology.tets, vertices().detach()), CELLS_OF_A_LEAF)

    return topology.cached(f"hierarchy.cells.{backend.name}", build)


@dataclass
class Hierarchy:
    """Boxes around boxes around some items.

    Attributes:
        backend: Array types.
        leaves: The items.
        boxes: (2 L, 8) least and negated greatest coordinates of each node, and two of padding; infinite where it has
            no items.
    """

    backend: Backend
    leaves: Leaves
    boxes: Any

    @staticmethod
    def over(leaves: Leaves, cells: Cells) -> Hierarchy:
        """Build the boxes of items with vertices of some cells, in their precision; may be recorded."""
        backend = cells.backend
        boxes, below = (dr.empty(backend.Float, size << leaves.level) for size in (16, 8))
        box = _leaf_boxes(leaves, cells)
        _store(backend, below, leaves.leaf, box)
        _store(backend, boxes, leaves.first + leaves.leaf, box)
        dr.eval(boxes, below)
        level = leaves.level
        for above, node in zip(_levels_above(level), leaves.above, strict=True):
            below, level = _raised(backend, boxes, below, node, (level, above)), above
        return Hierarchy(backend, leaves, boxes)

    @property
    def size(self) -> Any:
        """Greatest coordinate of any box."""
        low, high = _box(self.backend, self.boxes, self.backend.UInt(1))
        return largest_coordinate([low, high])

    def meet_lines(self, beam: Beam, visit: Callable[[Any, Any, Any], Any], state: Any) -> Any:
        """Visit all items whose boxes may be crossed by a ray between two distances, and some more, in any order.

        Args:
            beam: The rays.
            visit: Takes an item, a mask and the state, and returns the new state.
            state: A PyTree as wide as the rays.
        """
        test = beam.crosses(self.margin(beam.farthest))
        return self._descend(test, beam.valid, 0, lambda leaf, state: self._at_items(leaf, visit, state), state)

    def meet_blocks(
        self, beam: Beam, visit: Callable[[Any, Any], Any], state: Any, is_done: Callable[[Any], Any]
    ) -> Any:
        """The same for :attr:`block` items at a time.

        Args:
            beam: The rays.
            visit: Takes the number of a block and the state, and returns the new state.
            state: A PyTree as wide as the rays.
            is_done: Takes the state, and tells which rays need no more.
        """
        test = beam.crosses(self.margin(beam.farthest))
        return self._descend(test, beam.valid, self._levels_of_blocks, visit, state, is_done)

    @property
    def block(self) -> int:
        """Items of a block, which follow each other."""
        return self.leaves.leaf_items << self._levels_of_blocks

    @property
    def _levels_of_blocks(self) -> int:
        return min(_BLOCK_LEVELS, self.leaves.level)

    def meet_points(
        self,
        point: Triple,
        slack: float,
        active: Any,
        visit: Callable[[Any, Any, Any], Any],
        state: Any,
        is_done: Callable[[Any], Any] | None = None,
    ) -> Any:
        """Visit all items whose boxes hold a point, or nearly so.

        Args:
            point: The points.
            slack: How much larger boxes are taken than they are, in parts of their longest sides.
            active: Which of them.
            visit: Takes an item, a mask and the state, and returns the new state.
            state: A PyTree as wide as the points.
            is_done: Takes the state, and tells which points need no more items; None where all do.
        """
        margin = self.margin(point)

        def holds(center: list[Any], half: list[Any]) -> Any:
            around = dr.fma(dr.fmax(dr.fmax(half[0], half[1]), half[2]), slack, margin)
            is_in = dr.mask_t(margin)(True)
            for x, c, h in zip(point, center, half, strict=True):
                is_in &= dr.abs(x - c) <= h + around
            return is_in

        return self._descend(holds, active, 0, lambda leaf, state: self._at_items(leaf, visit, state), state, is_done)

    def margin(self, point: Triple) -> Any:
        """By how much, at most, rounding moves boxes as seen from points."""
        farthest = dr.fmax(dr.fmax(dr.abs(point[0]), dr.abs(point[1])), dr.abs(point[2]))
        return rounding_of(farthest + self.size)

    def item(self, place: Any) -> tuple[Any, Any]:
        """Items by their places along the curve, and whether there are any."""
        is_there = place < self.leaves.count
        return dr.gather(self.backend.UInt, self.leaves.items, place, is_there), is_there

    def _at_items(self, leaf: Any, visit: Callable[[Any, Any, Any], Any], state: Any) -> Any:
        """Visit the items of leaves."""
        count = self.leaves.leaf_items

        def at_item(place: Any, state: Any) -> tuple[Any, Any]:
            item, is_there = self.item(place)
            return place + 1, visit(item, is_there, state)

        first = leaf * count
        if count == 1:
            return at_item(first, state)[1]
        end = first + count
        return dr.while_loop((first, state), lambda place, _: place < end, at_item)[1]

    def _descend(
        self,
        test: Callable[[list[Any], list[Any]], Any],
        active: Any,
        above: int,
        visit: Callable[[Any, Any], Any],
        state: Any,
        is_done: Callable[[Any], Any] | None = None,
    ) -> Any:
        """Visit the nodes so many levels above the leaves whose boxes pass a test, counted along the curve."""
        backend, uint = self.backend, self.backend.UInt
        bottom = self.leaves.first >> above

        def body(node: Any, state: Any) -> tuple[Any, Any]:
            low, high = _box(backend, self.boxes, node)
            center = [0.5 * (a + b) for a, b in zip(low, high, strict=True)]
            is_met = test(center, [0.5 * (b - a) for a, b in zip(low, high, strict=True)])
            is_leaf = node >= bottom
            state = dr.if_stmt(
                (node, state),
                is_met & is_leaf,
                lambda node, state: visit(node - bottom, state),
                lambda _, state: state,
            )
            behind = node + 1
            behind >>= dr.tzcnt(behind)
            ends = behind == 1 if is_done is None else (behind == 1) | is_done(state)
            return dr.select(is_met & ~is_leaf, 2 * node, dr.select(ends, uint(0), behind)), state

        root = dr.select(active, uint(1), uint(0))
        return dr.while_loop((root, state), lambda node, _: node != 0, body)[1]


def curve_order(points: torch.Tensor) -> torch.Tensor:
    """(N,) int64 permutation of (N, 3) points that brings those that are near each other together: a Morton curve."""
    if not points.shape[0]:
        return torch.zeros(0, dtype=torch.int64, device=points.device)
    low, high = torch.aminmax(points, dim=0)
    scale = ((1 << _CURVE_BITS) - 1) / (high - low).amax().clamp(min=torch.finfo(points.dtype).tiny)
    codes = []
    for part in chunks(points.shape[0], points.device, width=4):
        cells = ((points[part] - low) * scale).long().clamp(0, (1 << _CURVE_BITS) - 1)
        x, y, z = (_spread(column) for column in cells.unbind(1))
        codes.append(x | (y << 1) | (z << 2))
    return torch.argsort(torch.cat(codes))


def _centers(vertices: torch.Tensor, corners: torch.Tensor) -> torch.Tensor:
    """(N, 3) means of the corners of items."""
    sums = vertices.index_select(0, corners[:, 0])
    for column in corners[:, 1:].unbind(1):
        sums += vertices.index_select(0, column)
    return sums / corners.shape[1]


def _spread(values: torch.Tensor) -> torch.Tensor:
    """Two zero bits after every bit of up to 21."""
    for shift, mask in ((32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F)):
        values = (values | (values << shift)) & mask
    values = (values | (values << 4)) & 0x10C30C30C30C30C3
    return (values | (values << 2)) & 0x1249249249249249


def _box(backend: Backend, boxes: Any, node: Any) -> tuple[list[Any], list[Any]]:
    """Least and greatest coordinates of a node."""
    first, second = (dr.gather(backend.Float4, boxes, 2 * node + k) for k in range(2))
    return [first[0], first[1], first[2]], [-first[3], -second[0], -second[1]]


def _store(backend: Backend, boxes: Any, row: Any, *nodes: list[Any]) -> None:
    """Write least and negated greatest coordinates of nodes that follow each other; rows have so many.

    All at once, for each time that an array is written to takes a kernel of its own.
    """
    zero = backend.Float(0)
    dr.scatter(boxes, backend.Floats([value for ends in nodes for value in (*ends, zero, zero)]), row)


def _leaf_boxes(leaves: Leaves, cells: Cells) -> list[Any]:
    """Least and negated greatest coordinates of the leaves."""
    uint = cells.backend.UInt
    ends = [cells.backend.Float(dr.inf) for _ in range(6)]
    for k in range(leaves.leaf_items):
        item = leaves.leaf_items * leaves.leaf + k
        is_there = item < leaves.count
        for column in range(leaves.width):
            point = cells.point(dr.gather(uint, leaves.corners, leaves.width * item + column, is_there), is_there)
            corner = (*point, *(-x for x in point))
            ends = [dr.fmin(a, dr.select(is_there, b, dr.inf)) for a, b in zip(ends, corner, strict=True)]
    return ends


def _raised(backend: Backend, boxes: Any, below: Any, node: Any, levels: tuple[int, int]) -> Any:
    """Write the boxes of all levels from one to another further up, of those of the first; returns those of the last.

    Args:
        backend: Array types.
        boxes: All boxes.
        below: Those of the nodes of the first level.
        node: Numbers of the nodes of the last level.
        levels: These two.
    """
    level, last = levels
    ends = _children(backend, below, node, 1 << (level - last))
    while level > last:
        level -= 1
        ends = [[dr.fmin(a, b) for a, b in zip(*pair, strict=True)] for pair in zip(ends[::2], ends[1::2], strict=True)]
        # Nodes 2^level + 2^(level - last) node and on.
        _store(backend, boxes, (1 << last) + node, *ends)
    top = dr.empty(backend.Float, 8 << last)
    _store(backend, top, node, ends[0])
    dr.eval(boxes, top)
    return top


def _children(backend: Backend, below: Any, node: Any, count: int) -> list[list[Any]]:
    """The boxes of the nodes below others, ``count`` of each."""
    found = []
    for k in range(count):
        first, second = (dr.gather(backend.Float4, below, 2 * (count * node + k) + half) for half in range(2))
        found.append([first[0], first[1], first[2], first[3], second[0], second[1]])
    return found
