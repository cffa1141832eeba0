"""Cells of a front-to-back order, sorted into the image's tiles (Dr.Jit and PyTorch)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.rendering.search.scene import Scene
from difftetvr.rendering.tracers.bands import bands_of

TILE_BITS = 2
"""Tiles have 4 x 4 pixels: those of 16 lanes that lie side by side in Morton order, a vector of AVX-512."""


@dataclass
class TileLists:
    """Cells that may be seen through each tile, front to back.

    Attributes:
        begin, end: (tiles,) part of ``cells`` that belongs to each tile, row by row.
        cells: Cell indices.
    """

    begin: Any
    end: Any
    cells: Any


class Tiler:
    """Sorts the cells of a view into tiles, some at a time."""

    def __init__(self, scene: Scene, order: torch.Tensor, budget: int) -> None:
        """Find the tiles of each cell.

        Args:
            scene: The cells, and the rays of a camera.
            order: (T,) cell indices, front to back.
            budget: Pairs of cell and tile to hold at a time; a single cell may have more.
        """
        self.scene = scene
        width, height = scene.image.size
        self.columns = _tiles(width)
        self.count = self.columns * _tiles(height)
        backend, uint = scene.backend, scene.backend.UInt
        cell = backend.uints(order.to(torch.int32))
        corners = scene.cell(cell)
        columns, rows, visible = scene.image.pixel_range(scene.backend, [scene.point(corners[k]) for k in range(4)])
        shift = lambda value: uint(dr.select(visible, value, 0)) >> TILE_BITS  # noqa: E731
        column0, column1, row0, row1 = (shift(value) for value in (*columns, *rows))
        self.width = backend.Int(column1 - column0 + 1)
        pairs = dr.select(visible, self.width * backend.Int(row1 - row0 + 1), 0)
        self.first = backend.Int(row0 * self.columns + column0)
        backend.run(pairs, self.width, self.first)
        seen = torch.nonzero(backend.tensor(pairs) > 0).flatten()
        # Cells out of sight are left out: often they are most of all.
        self.cells = order.to(torch.int32)[seen]
        self.pairs, self.width, self.first = (backend.tensor(part)[seen] for part in (pairs, self.width, self.first))
        self.parts = [slice(band.first, band.last) for band in bands_of(self.pairs.long(), budget)]

    def lists(self) -> Iterator[TileLists]:
        """Lists of the first cells of the order, then of the next, and so on."""
        return (self._lists(part) for part in self.parts)

    def _lists(self, part: slice) -> TileLists:
        backend = self.scene.backend
        pairs, width, first = self.pairs[part], self.width[part], self.first[part]
        owner = torch.repeat_interleave(torch.arange(pairs.shape[0], device=pairs.device, dtype=torch.int32), pairs)
        place = torch.arange(owner.shape[0], device=pairs.device, dtype=torch.int32)
        place -= (pairs.cumsum(0) - pairs).to(torch.int32)[owner]
        row = torch.div(place, width[owner], rounding_mode="floor")
        tiles = first[owner] + row * self.columns + (place - row * width[owner])
        # Stable: within a tile, cells stay in their order.
        tiles, permutation = torch.sort(tiles, stable=True)
        bounds = torch.searchsorted(tiles, torch.arange(self.count + 1, device=tiles.device, dtype=tiles.dtype))
        bounds = bounds.to(torch.int32)
        lists = TileLists(
            backend.uints(bounds[:-1]), backend.uints(bounds[1:]), backend.uints(self.cells[part][owner[permutation]])
        )
        backend.run(lists)
        return lists


def _tiles(pixels: int) -> int:
    return -(-pixels // (1 << TILE_BITS))
