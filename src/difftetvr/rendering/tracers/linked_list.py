"""The linked-list renderer: fragments of every pixel, sorted front to back (article section 4; Dr.Jit).

Each ray sorts its fragments by a heap in local memory. When a list is longer than that memory, the nearest fragments
are taken first and the list is gone through again for those behind them, so nothing is dropped, whatever the depth
complexity. The image is made in bands when the lists of all pixels together would be too large.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.backend import NONE, Backend
from difftetvr.mesh import TetMesh
from difftetvr.recording import few_lengths
from difftetvr.rendering.search.bundle_hits import Stretches
from difftetvr.rendering.search.memory_order import MemoryOrder
from difftetvr.rendering.search.plan import Search, SearchPlan
from difftetvr.rendering.tracers.aim import Aim
from difftetvr.rendering.tracers.bands import Band, bands_of
from difftetvr.rendering.tracers.fragments import (
    BundleFragments,
    CameraFragments,
    FragmentBand,
    FragmentLists,
    Fragments,
)
from difftetvr.rendering.traversal.crossing import Kernel, View, cross_cell
from difftetvr.rendering.traversal.rays import Lanes

FRAGMENT_BUDGET = 1 << 26
"""Fragments that lists may hold at a time, of 12 bytes each in float32."""

LOCAL_SIZES = (16, 32, 64, 128)
"""Fragments that a ray can hold in local memory: the smallest that suffices for all, or the largest."""


@dataclass
class LinkedList:
    """Sorts per-pixel lists of fragments.

    Attributes:
        view: What kernels read.
        search: Finds fragments.
        bands: All of the image; or, one after the other, parts of it whose lists fit the budget.
        local_size: Fragments that a ray sorts at a time.
        starts_inside: Whether some crossings begin behind the camera.
    """

    view: View
    search: Search
    bands: FragmentBand | ManyBands
    local_size: int
    starts_inside: bool

    @staticmethod
    def plan(backend: Backend, mesh: TetMesh, rays: Any, stretches: Stretches | None) -> SearchPlan:
        """How to find the fragments of rays: those of a camera, or stretches of a bundle."""
        if stretches is None:
            return CameraFragments.of(backend, MemoryOrder.of(mesh).tables(backend), rays)
        return BundleFragments.of(backend, mesh, stretches)

    @staticmethod
    def of(aim: Aim) -> LinkedList:
        """Take the fragments of every ray."""
        found: Fragments = aim.found
        size = next((size for size in LOCAL_SIZES if size >= found.longest), LOCAL_SIZES[-1])
        return LinkedList(aim.view, found.search, _bands(aim.view, found), size, found.starts_inside)

    def on_lanes(self, lane: Any) -> None:
        """See :meth:`difftetvr.rendering.traversal.crossing.Tracer.on_lanes`."""

    def trace(self, make_kernel: Callable[[Lanes], Kernel]) -> None:
        """Sort every ray's fragments and cross their cells, front to back."""
        if isinstance(self.bands, FragmentBand):
            self._trace_band(make_kernel, self.bands)
            return
        for band in self.bands.each(self.view.backend):
            self._trace_band(make_kernel, band)
            self.view.backend.run()  # before the lists of the next band

    def _trace_band(self, make_kernel: Callable[[Lanes], Kernel], band: FragmentBand) -> None:
        lists = FragmentLists.of(self.search, band)
        rays = self.view.rays.of_lanes(band.lane)
        kernel = make_kernel(rays)
        kernel.finish(self._resolve(kernel, rays, lists, band))

    def _resolve(self, kernel: Kernel, rays: Lanes, lists: FragmentLists, band: FragmentBand) -> Any:
        view, scene = self.view, self.search.scene
        uint, real, lanes = view.backend.UInt, view.backend.Float, dr.width(rays.pixel)
        heads = dr.gather(uint, lists.heads, band.lane - band.first, rays.valid)

        def batch(more: Any, depth: Any, face: Any, ray: Any) -> tuple[Any, ...]:
            heap = _Heap(view.backend, self.local_size, lanes)
            count = heap.take_nearest(lists, dr.select(more, heads, NONE), depth, face)
            heap.sort(count)

            def cross(index: Any, ray: Any) -> tuple[Any, Any]:
                half_face = heap.faces.read(index)
                corners = scene.indices_and_apex(half_face)
                return index + 1, cross_cell(kernel, half_face >> 2, corners, ray, True)

            see = lambda index, ray: (index < count) & kernel.goes_on(ray)  # noqa: E731
            _, ray = dr.while_loop((dr.zeros(uint, lanes), ray), see, cross)
            last = dr.select(count > 0, count - 1, 0)
            depth, face = heap.depths.read(last, count > 0), heap.faces.read(last, count > 0)
            return (count == self.local_size) & kernel.goes_on(ray), depth, face, ray

        state = (
            rays.valid & (heads != NONE),
            dr.full(real, -dr.inf, lanes),
            dr.zeros(uint, lanes),
            kernel.start(),
        )
        return dr.while_loop(state, lambda more, *_: more, batch)[3]


class ManyBands:
    """Bands that must be waited for, each before the next: a recording would not, and hold the lists of several."""

    def __init__(self, parts: list[Band]) -> None:
        self._parts = parts

    def each(self, backend: Backend) -> Iterator[FragmentBand]:
        """The bands, one after the other."""
        return (_band(backend, part) for part in self._parts)


def _bands(view: View, found: Fragments) -> FragmentBand | ManyBands:
    """All lanes, as many at a time as the budget lets."""
    backend, lanes = view.backend, view.rays.lane_count
    # The total may have run over where it could be so great.
    if found.total <= FRAGMENT_BUDGET and found.longest * lanes < 1 << 32:
        return _band(backend, Band(0, lanes, found.total))
    parts = bands_of(backend.tensor(backend.Int(found.count)).long(), FRAGMENT_BUDGET)
    return _band(backend, parts[0]) if len(parts) == 1 else ManyBands(parts)


def _band(backend: Backend, part: Band) -> FragmentBand:
    count, first, last = part.last - part.first, backend.constant(part.first), backend.constant(part.last)
    lane = dr.arange(backend.UInt, count) + first if part.first else backend.lanes(count)
    dr.eval(lane)
    return FragmentBand(lane, first, last, count, few_lengths(part.total))


class _Heap:
    """The nearest fragments of a ray in local memory: a binary heap with the farthest of them at its root.

    Two habits of Dr.Jit 1.5 are heeded. Its loops mask gathers and scatters of lanes that are done, but not writes to
    local memory: every write here is masked by its loop's condition. And the state of a loop inside another loop must
    begin as wide as the lanes, or local memory gets wrong values: so does the root's index.
    """

    def __init__(self, backend: Backend, size: int, lanes: int) -> None:
        real, uint = backend.Float, backend.UInt
        self.real, self.uint, self.size = real, uint, size
        self.root = dr.zeros(uint, lanes)
        self.depths, self.faces = dr.alloc_local(real, size), dr.alloc_local(uint, size)

    def take_nearest(self, lists: FragmentLists, head: Any, depth: Any, face: Any) -> Any:
        """Take the nearest fragments of a list that lie behind the one at (depth, face); returns how many."""
        uint, lanes = self.uint, dr.width(head)

        def following(node: Any) -> Any:
            return dr.gather(uint, lists.following, node)

        def fill(node: Any, count: Any, depths: Any, faces: Any) -> tuple[Any, ...]:
            key = dr.gather(self.real, lists.depths, node), dr.gather(uint, lists.faces, node)
            behind = (node != NONE) & (count < self.size) & _is_before((depth, face), key)
            depths.write(key[0], count, behind)
            faces.write(key[1], count, behind)
            return following(node), dr.select(behind, count + 1, count), depths, faces

        state = (head, dr.zeros(uint, lanes), self.depths, self.faces)
        has_room = lambda node, count, *_: (node != NONE) & (count < self.size)  # noqa: E731
        node, count, self.depths, self.faces = dr.while_loop(state, has_room, fill)
        self._heapify(count)

        def replace(node: Any, depths: Any, faces: Any) -> tuple[Any, ...]:
            self.depths, self.faces = depths, faces
            key = dr.gather(self.real, lists.depths, node), dr.gather(uint, lists.faces, node)
            root = depths.read(uint(0)), faces.read(uint(0))
            nearer = (node != NONE) & _is_before((depth, face), key) & _is_before(key, root)
            self._sink(self.root, key, dr.select(nearer, uint(self.size), 0))
            return following(node), self.depths, self.faces

        rest = (node, self.depths, self.faces)
        _, self.depths, self.faces = dr.while_loop(rest, lambda node, *_: node != NONE, replace)
        return count

    def _heapify(self, count: Any) -> None:
        """Make the first ``count`` fragments a heap."""

        def place(parent: Any, depths: Any, faces: Any) -> tuple[Any, ...]:
            self.depths, self.faces = depths, faces
            self._sink(parent - 1, (depths.read(parent - 1), faces.read(parent - 1)), dr.select(parent > 0, count, 0))
            return parent - 1, self.depths, self.faces

        state = (count >> 1, self.depths, self.faces)
        _, self.depths, self.faces = dr.while_loop(state, lambda parent, *_: parent > 0, place)

    def sort(self, count: Any) -> None:
        """Sort the first ``count`` fragments, which are a heap, front to back."""
        uint = self.uint

        def extract(end: Any, depths: Any, faces: Any) -> tuple[Any, ...]:
            self.depths, self.faces = depths, faces
            root = depths.read(uint(0)), faces.read(uint(0))
            last = depths.read(end), faces.read(end)
            self._sink(self.root, last, end)
            self.depths.write(root[0], end, end > 0)
            self.faces.write(root[1], end, end > 0)
            return end - 1, self.depths, self.faces

        state = (dr.select(count > 0, count - 1, 0), self.depths, self.faces)
        _, self.depths, self.faces = dr.while_loop(state, lambda end, *_: end > 0, extract)

    def _sink(self, hole: Any, key: tuple[Any, Any], size: Any) -> None:
        """Put a key into the heap of the first ``size`` fragments at ``hole`` or below it; none where size is 0."""
        uint = self.uint

        def descend(active: Any, hole: Any, depths: Any, faces: Any) -> tuple[Any, ...]:
            left = 2 * hole + 1
            right = dr.select(left + 1 < size, left + 1, left)
            one, other = ((depths.read(child), faces.read(child)) for child in (left, right))
            goes_right = _is_before(one, other)
            child = dr.select(goes_right, right, left)
            larger = tuple(dr.select(goes_right, y, x) for x, y in zip(one, other, strict=True))
            moves = active & _is_before(key, larger)
            depths.write(larger[0], hole, moves)
            faces.write(larger[1], hole, moves)
            hole = dr.select(moves, child, hole)
            return moves & (2 * hole + 1 < size), hole, depths, faces

        state = (2 * hole + 1 < size, uint(hole), self.depths, self.faces)
        _, hole, self.depths, self.faces = dr.while_loop(state, lambda active, *_: active, descend)
        self.depths.write(key[0], hole, size > 0)
        self.faces.write(key[1], hole, size > 0)


def _is_before(one: tuple[Any, Any], other: tuple[Any, Any]) -> Any:
    """Whether a fragment's key (depth, half-face) is the smaller one."""
    return (one[0] < other[0]) | ((one[0] == other[0]) & (one[1] < other[1]))
