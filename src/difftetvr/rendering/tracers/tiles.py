"""Cells of a front-to-back order, sorted into the image's tiles (Dr.Jit and PyTorch)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import drjit as dr
import torch

from difftetvr.backend import Backend
from difftetvr.recording import few_lengths, replayed
from difftetvr.rendering.search.scene import Scene
from difftetvr.rendering.tracers.bands import Band, bands_of

TILE_BITS = 2
"""Tiles have 4 x 4 pixels: those of 16 lanes that lie side by side in Morton order, a vector of AVX-512."""


@dataclass
class TileLists:
    """Cells that may be seen through each tile, front to back.

    Attributes:
        bounds: (tiles + 1,) signed, where in ``cells`` those of each tile begin, row by row, and where the last ones
            end.
        cells: Cell indices, signed.
    """

    bounds: Any
    cells: Any


@dataclass
class CellTiles:
    """The tiles through which each cell may be seen, a rectangle of them.

    Attributes:
        pairs: (T,) how many these are.
        width: (T,) how many in a row.
        first: (T,) the first of them.
    """

    pairs: Any
    width: Any
    first: Any


def tiles_of(scene: Scene, cell: Any) -> CellTiles:
    """Find the tiles of cells, for :func:`difftetvr.recording.replayed`.

    Args:
        scene: The cells, and the rays of a camera.
        cell: (T,) their numbers.
    """
    backend, image = scene.backend, scene.image
    uint, integer = backend.UInt, backend.Int
    corners = scene.cell(cell)
    columns, rows, visible = image.pixel_range(backend, [scene.point(corners[k]) for k in range(4)])
    column0, column1, row0, row1 = (uint(dr.select(visible, end, 0)) >> TILE_BITS for end in (*columns, *rows))
    width = integer(column1 - column0 + 1)
    pairs = dr.select(visible, width * integer(row1 - row0 + 1), 0)
    first = integer(row0 * _tiles(image.width) + column0)
    dr.eval(pairs, width, first)
    return CellTiles(pairs, width, first)


class Tiler:
    """Sorts the cells of a view into tiles, some at a time."""

    def __init__(self, scene: Scene, tiles: CellTiles, order: torch.Tensor, pairs: int | None, budget: int) -> None:
        """Take cells apart.

        Args:
            scene: The cells, and the rays of a camera.
            tiles: Those of each cell.
            order: (T,) cell indices, front to back.
            pairs: How many pairs of cell and tile there are; None where nobody knows.
            budget: Pairs of cell and tile to hold at a time; a single cell may have more.
        """
        self.backend, self.tiles, (width, height) = scene.backend, tiles, scene.image.size
        self.columns = _tiles(width)
        self.count = self.columns * _tiles(height)
        self.cells = order.to(torch.int32)
        bands = [Band(0, len(order), pairs or 0)]
        if pairs is None or pairs > budget:
            bands = bands_of(self.backend.tensor(tiles.pairs).index_select(0, order).long(), budget)
        self.parts = [band for band in bands if band.total]

    def lists(self) -> Iterator[TileLists]:
        """Lists of the first cells of the order, then of the next, and so on."""
        return (self._lists(part) for part in self.parts)

    def _lists(self, part: Band) -> TileLists:
        backend = self.backend
        is_whole = part.last - part.first == len(self.cells)
        cells = backend.ints(self.cells if is_whole else self.cells[part.first : part.last])
        source = _CellsInOrder(backend, cells, self.tiles, backend.constant(self.columns))
        found = replayed(_pairs_of, source, few_lengths(part.total))
        tiles, owners = (backend.tensor(row)[: part.total] for row in found)
        # Stable: within a tile, cells stay in their order.
        tiles, permutation = torch.sort(tiles, stable=True)
        bounds = torch.searchsorted(tiles, _numbers(self.count + 1, tiles.device), out_int32=True)
        return TileLists(backend.ints(bounds), backend.ints(owners.index_select(0, permutation)))


@dataclass
class _CellsInOrder:
    """Some cells, front to back, and the tiles of any."""

    backend: Backend
    cell: Any
    tiles: CellTiles
    columns: Any


def _pairs_of(source: _CellsInOrder, length: int) -> tuple[Any, Any]:
    """(length,) tiles and (length,) cells of all pairs, cell by cell; for :func:`difftetvr.recording.replayed`."""
    integer, uint, of_cell = source.backend.Int, source.backend.UInt, source.tiles
    tiles, cells = dr.empty(integer, length), dr.empty(integer, length)
    cell = uint(source.cell)
    pairs, width, first = (uint(dr.gather(integer, row, cell)) for row in (of_cell.pairs, of_cell.width, of_cell.first))
    begin = dr.prefix_sum(pairs)

    def write(place: Any, column: Any, tile: Any) -> tuple[Any, Any, Any]:
        dr.scatter(tiles, integer(tile), begin + place)
        dr.scatter(cells, integer(cell), begin + place)
        # Without a division: in lanes that are done it would be by 0, which stops the program.
        is_last = column + 1 == width
        step = dr.select(is_last, source.columns - width + 1, uint(1))
        return place + 1, dr.select(is_last, uint(0), column + 1), tile + step

    dr.while_loop((uint(0), uint(0), first), lambda place, column, tile: place < pairs, write)
    dr.eval(tiles, cells)
    return tiles, cells


@lru_cache(maxsize=16)
def _numbers(count: int, device: torch.device) -> torch.Tensor:
    """(count,) int32 numbers from 0, which are shared and must not be changed."""
    return torch.arange(count, dtype=torch.int32, device=device)


def _tiles(pixels: Any) -> Any:
    """How many tiles hold so many pixels in a row."""
    return (pixels + ((1 << TILE_BITS) - 1)) >> TILE_BITS
