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
from difftetvr.rendering.traversal.rays import Frame, rounding_of

CELLS_OF_A_LEAF = 2
"""Searches among cells are slower with one or with four."""

_CURVE_BITS = 20  # of each coordinate


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


def sorted_cells(topology: Topology, vertices: torch.Tensor) -> SortedItems:
    """All cells of a mesh, sorted by where they are among (V, 3) vertices the first time."""
    cells = torch.arange(topology.num_cells, device=topology.tets.device)
    return topology.cached("hierarchy.cells", lambda: SortedItems.of(cells, topology.tets, vertices.detach()))


@dataclass
class Hierarchy:
    """Boxes around boxes around some items.

    Attributes:
        backend: Array types.
        boxes: (2 L, 8) least and negated greatest coordinates of each node, and two of padding; infinite where it has
            no items.
        items: (N,) numbers of the items, those of a leaf next to each other.
        count: N, as a device value.
        leaves: L, as a device value.
        leaf_items: How many items a leaf has.
        size: Greatest coordinate of any box, as a device value.
    """

    backend: Backend
    boxes: Any
    items: Any
    count: Any
    leaves: Any
    leaf_items: int
    size: Any

    @staticmethod
    def over(backend: Backend, sorted_items: SortedItems, vertices: torch.Tensor, leaf_items: int) -> Hierarchy:
        """Build the boxes of items.

        Args:
            backend: Back end of the vertices' device and precision.
            sorted_items: The items.
            vertices: (V, 3) positions.
            leaf_items: Items in a leaf: one for speed, several for less memory.
        """
        count = sorted_items.items.shape[0]
        used = -(-count // leaf_items)
        leaves = 1 << max(0, (used - 1).bit_length())
        boxes = torch.full((2 * leaves, 8), torch.inf, dtype=backend.dtype, device=backend.device)
        boxes[leaves : leaves + used] = _leaf_boxes(backend, sorted_items, vertices, leaf_items)
        level = leaves
        while level > 1:
            torch.minimum(boxes[level : 2 * level : 2], boxes[level + 1 : 2 * level : 2], out=boxes[level // 2 : level])
            level //= 2
        hierarchy = Hierarchy(
            backend,
            backend.floats(boxes),
            backend.uints(sorted_items.items),
            backend.opaque_uint(count),
            backend.opaque_uint(leaves),
            leaf_items,
            backend.floats(boxes[1, :6].abs().amax()[None]),
        )
        backend.run(hierarchy.boxes, hierarchy.items, hierarchy.size)
        return hierarchy

    def meet_lines(
        self, frame: Frame, near: Any, far: Any, active: Any, visit: Callable[[Any, Any, Any], Any], state: Any
    ) -> Any:
        """Visit all items whose boxes may be crossed by a ray between two distances, and some more, in any order.

        Args:
            frame: The rays; they have origins.
            near, far: Distances along each.
            active: Which of them.
            visit: Takes an item, a mask and the state, and returns the new state.
            state: A PyTree as wide as the rays.
        """
        assert frame.origin is not None
        d, margin = frame.direction, self._margin(frame.origin)
        e = [dr.abs(component) for component in d]

        def meets(center: list[Any], half: list[Any]) -> Any:
            c = [x - o for x, o in zip(center, frame.origin or (), strict=True)]
            ahead = dr.fma(c[0], d[0], dr.fma(c[1], d[1], c[2] * d[2]))
            reach = dr.fma(half[0], e[0], dr.fma(half[1], e[1], dr.fma(half[2], e[2], margin)))
            is_met = (ahead + reach >= near) & (ahead - reach <= far)
            for i, j in ((1, 2), (2, 0), (0, 1)):  # the axes at right angles to the line and to a side of the box
                beside = dr.abs(c[i] * d[j] - c[j] * d[i])
                is_met &= beside <= dr.fma(half[i], e[j], dr.fma(half[j], e[i], margin))
            return is_met

        return self._visit(meets, active, visit, state)

    def meet_points(
        self,
        point: tuple[Any, Any, Any],
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
        margin = self._margin(point)

        def holds(center: list[Any], half: list[Any]) -> Any:
            around = dr.fma(dr.fmax(dr.fmax(half[0], half[1]), half[2]), slack, margin)
            is_in = dr.mask_t(margin)(True)
            for x, c, h in zip(point, center, half, strict=True):
                is_in &= dr.abs(x - c) <= h + around
            return is_in

        return self._visit(holds, active, visit, state, is_done)

    def _margin(self, point: tuple[Any, Any, Any]) -> Any:
        farthest = dr.fmax(dr.fmax(dr.abs(point[0]), dr.abs(point[1])), dr.abs(point[2]))
        return rounding_of(farthest + self.size)

    def _visit(
        self,
        test: Callable[[list[Any], list[Any]], Any],
        active: Any,
        visit: Callable[..., Any],
        state: Any,
        is_done: Callable[[Any], Any] | None = None,
    ) -> Any:
        uint, float4 = self.backend.UInt, self.backend.Float4

        def at_item(place: Any, state: Any) -> tuple[Any, Any]:
            is_there = place < self.count
            return place + 1, visit(dr.gather(uint, self.items, place, is_there), is_there, state)

        def at_leaf(node: Any, state: Any) -> Any:
            first = (node - self.leaves) * self.leaf_items
            if self.leaf_items == 1:
                return at_item(first, state)[1]
            end = first + self.leaf_items
            return dr.while_loop((first, state), lambda place, _: place < end, at_item)[1]

        def body(node: Any, state: Any) -> tuple[Any, Any]:
            first, second = (dr.gather(float4, self.boxes, 2 * node + k) for k in range(2))
            low, high = [first[0], first[1], first[2]], [-first[3], -second[0], -second[1]]
            center = [0.5 * (a + b) for a, b in zip(low, high, strict=True)]
            is_met = test(center, [0.5 * (b - a) for a, b in zip(low, high, strict=True)])
            is_leaf = node >= self.leaves
            state = dr.if_stmt((node, state), is_met & is_leaf, at_leaf, lambda _, state: state)
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


def _leaf_boxes(backend: Backend, sorted_items: SortedItems, vertices: torch.Tensor, leaf_items: int) -> torch.Tensor:
    """(L, 8) least and negated greatest coordinates of the leaves that have items, and padding."""
    uint, real = backend.UInt, backend.Float
    positions, corners = backend.floats(vertices), backend.uints(sorted_items.corners)
    count, width = sorted_items.corners.shape
    leaf, last = dr.arange(uint, -(-count // leaf_items)), backend.opaque_uint(count - 1)
    ends = [real(dr.inf) for _ in range(6)]
    for k in range(leaf_items):
        item = leaf_items * leaf + k
        item = dr.select(item < last, item, last)
        for column in range(width):
            vertex = dr.gather(uint, corners, width * item + column)
            point = [dr.gather(real, positions, 3 * vertex + axis) for axis in range(3)]
            ends = [dr.fmin(a, b) for a, b in zip(ends, [*point, *(-x for x in point)], strict=True)]
    boxes = dr.empty(real, 8 * dr.width(leaf))
    dr.scatter(boxes, backend.Float4(*ends[:4]), 2 * leaf)
    dr.scatter(boxes, backend.Float4(*ends[4:], 0, 0), 2 * leaf + 1)
    return backend.tensor(boxes, -1, 8)
