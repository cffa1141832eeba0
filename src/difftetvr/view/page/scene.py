"""A volume as a page holds it: quantised to what the eye cannot tell, and in an order that packs well (PyTorch)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from difftetvr.errors import MeshError, counted
from difftetvr.mesh import Field, TetMesh
from difftetvr.mesh.harmonics import COUNTS
from difftetvr.optics import coefficients
from difftetvr.rendering import ScalarField
from difftetvr.rendering.search.hierarchy import curve_order
from difftetvr.view.page.packing import Integers, Pack

_COARSE, _FINE = 16, 24  # bits of a coordinate or a scalar
_COLOR_BITS, _DENSITY_BITS = 8, 10  # of a half float's mantissa; 10 are all
_MOST_VERTICES = 1 << 24
_GREATEST_HALF = 65504.0
_NARROW = 16.0  # so many times wider than what is looked at, scalars need the finer steps


@dataclass(frozen=True)
class Scene:
    """A quantised volume.

    Attributes:
        pack: Its arrays, and the header that says how to read them.
        inverted: Number of cells that rounding has turned inside out; a ray takes them as having no length.
    """

    pack: Pack
    inverted: int

    @staticmethod
    def of(mesh: TetMesh, field: Field | ScalarField) -> Scene:
        """Quantises a volume.

        Args:
            mesh: The mesh; its cells meet face to face.
            field: What it emits and absorbs.

        Raises:
            MeshError: The cells are loose, the field is not one of the mesh or has other than three colours, or there
                are more vertices than a page can count.
        """
        _require_drawable(mesh, field)
        order = curve_order(mesh.vertices.detach())
        cells, odd, cell_order = _sorted_cells(mesh.tets.cpu(), order.cpu())
        box = Box.of(mesh)
        positions, bits, inverted = _quantised_positions(box, cells, odd, order.cpu())
        location = field.location_on(mesh)
        pack = Pack(
            {
                "vertices": mesh.num_vertices,
                "cells": mesh.num_cells,
                "location": location,
                "kind": "scalar" if isinstance(field, ScalarField) else "color",
                "box": {"center": box.center.tolist(), "size": box.size},
                "optics": {name.lower(): getattr(coefficients, name) for name in _OPTICS},
            }
        )
        pack.add("positions", positions, bits // 8, differences=True, bits=bits)
        _add_cells(pack, cells, odd)
        kept = order.cpu() if location == "vertex" else torch.from_numpy(cell_order)
        if isinstance(field, ScalarField):
            _add_scalars(pack, field, kept, box)
        else:
            _add_colors(pack, field, kept, box)
        return Scene(pack, inverted)


_OPTICS = ("THIN", "VISIBLE", "H", "SINH", "P", "U", "NODES", "WEIGHTS")


@dataclass(frozen=True)
class Box:
    """Where the mesh is in the world; a page counts positions from its centre, in units of its longest side.

    Attributes:
        positions: (V, 3) float64 positions in world space.
        lower: (3,) corner of the box.
        extent: (3,) sides.
    """

    positions: np.ndarray
    lower: np.ndarray
    extent: np.ndarray

    @staticmethod
    def of(mesh: TetMesh) -> Box:
        """The box of a mesh's vertices."""
        positions = mesh.positions.detach().cpu().numpy()
        lower = positions.min(axis=0)
        return Box(positions, lower, positions.max(axis=0) - lower)

    @property
    def center(self) -> np.ndarray:
        """(3,) middle."""
        return self.lower + 0.5 * self.extent

    @property
    def size(self) -> float:
        """Longest side."""
        return float(self.extent.max())


def _require_drawable(mesh: TetMesh, field: Field | ScalarField) -> None:
    location = field.location_on(mesh)
    if not mesh.is_conforming:
        raise MeshError(
            "The cells of this mesh do not meet face to face, and a page walks from cell to cell through their faces; "
            "render pictures of it instead, or mesh it anew."
        )
    if mesh.num_vertices > _MOST_VERTICES:
        raise MeshError(f"The mesh has {counted(mesh.num_vertices, 'vertex', 'vertices')}, of which a page holds 2^24.")
    if not mesh.num_cells:
        raise MeshError("The mesh has no cell, so there is nothing to show.")
    if isinstance(field, ScalarField):
        return
    field.validate(mesh)
    if field.color.shape[1] != 3:
        raise MeshError(
            f"The field has {counted(field.color.shape[1], 'channel')} for each {location}; a page shows linear RGB, "
            "so choose three of them."
        )


def _sorted_cells(tets: torch.Tensor, order: torch.Tensor) -> tuple[Integers, np.ndarray, np.ndarray]:
    """Cells in an order that packs well.

    Args:
        tets: (T, 4) vertices.
        order: (V,) number of each vertex in the mesh, along the curve.

    Returns:
        (T, 4) vertices along the curve, ascending in each cell and from cell to cell; (T,) whether that order is an odd
        permutation of the positive one; and (T,) number of each cell in the mesh.
    """
    places = np.empty(len(order), dtype=np.int64)
    places[order.numpy()] = np.arange(len(order))
    corners = places[tets.numpy()]
    sorting = np.argsort(corners, axis=1)
    cells = np.take_along_axis(corners, sorting, axis=1)
    inversions = sum((sorting[:, i] > sorting[:, j]).astype(np.int64) for i in range(4) for j in range(i + 1, 4))
    cell_order = np.lexsort(cells.T[::-1])
    return cells[cell_order], (np.asarray(inversions)[cell_order] & 1).astype(bool), cell_order


def _quantised_positions(box: Box, cells: Integers, odd: np.ndarray, order: torch.Tensor) -> tuple[Integers, int, int]:
    """(V, 3) positions along the curve in steps of the longest side, bits of the steps, and number of inverted cells.

    As few bits as invert no cell; a float32 of the browser holds no more than 24.
    """
    relative = (box.positions[order.numpy()] - box.lower) / (box.size or 1.0)
    for bits in (_COARSE, _FINE):
        positions = np.rint(relative * ((1 << bits) - 1)).astype(np.int64)
        inverted = _count_inverted(positions, cells, odd)
        if not inverted:
            break
    return positions, bits, inverted


def _count_inverted(positions: Integers, cells: Integers, odd: np.ndarray) -> int:
    corners = positions.astype(np.float64)[cells]
    first, second, third = (corners[:, k] - corners[:, 0] for k in (1, 2, 3))
    volumes = (third * np.cross(first, second)).sum(axis=1)
    return int((np.where(odd, -volumes, volumes) <= 0).sum())


def _add_cells(pack: Pack, cells: Integers, odd: np.ndarray) -> None:
    """Vertices as differences that are never negative, as cells and their vertices ascend."""
    above = np.concatenate([np.zeros((1, 4), dtype=np.int64), cells[:-1]])
    steps = np.diff(cells, axis=1, prepend=above[:, :1])
    same = steps[:, 0] == 0
    same[0] = False
    # Cells around one vertex ascend by their second one.
    steps[same, 1] = cells[same, 1] - above[same, 1]
    pack.add("cells", steps, 3)
    pack.add("odd", np.packbits(odd, bitorder="little").astype(np.int64), 1)


def _add_scalars(pack: Pack, field: ScalarField, kept: torch.Tensor, box: Box) -> None:
    """Scalars in units of what the transfer function spans, and that function."""
    scalar = field.normalised().detach().cpu().double()[kept].numpy()
    low, high = float(scalar.min()), float(scalar.max())
    bits = _COARSE if high - low <= _NARROW else _FINE
    step = (high - low) / ((1 << bits) - 1) or 1.0
    pack.add("scalar", np.rint((scalar - low) / step).astype(np.int64), bits // 8, differences=True, low=low, step=step)
    function = field.transfer_function
    span = field.value_range or tuple(float(v) for v in torch.aminmax(field.scalar.detach()))
    pack.header["transfer"] = {
        "scalar": _numbers(function.scalar),
        "opacity": _numbers(function.opacity),
        "color": _numbers(function.color),
        "density": field.attenuation * box.size,
        "range": span,
    }


def _add_colors(pack: Pack, field: Field, kept: torch.Tensor, box: Box) -> None:
    """Colours and densities as half floats, which hold 0 and small values as well as great ones; harmonics in bytes."""
    density = (field.density.detach().cpu().double()[kept] * box.size).numpy()
    _add_halves(pack, "color", field.color.detach().cpu().double()[kept].numpy(), _COLOR_BITS)
    _add_halves(pack, "density", density, _DENSITY_BITS)
    if field.harmonics is None:
        return
    harmonics = field.harmonics.detach().cpu().double()[kept].flatten(1).numpy()
    scale = np.abs(harmonics).max(axis=0) / 127.0
    steps = np.rint(harmonics / np.where(scale > 0, scale, 1.0)).astype(np.int64) + 128
    degree = COUNTS.index(field.harmonics.shape[1])
    pack.add("harmonics", steps, 1, scale=scale.tolist(), degree=degree)


def _add_halves(pack: Pack, name: str, values: np.ndarray, mantissa: int) -> None:
    """Half floats less the last bits of their mantissa."""
    dropped = 10 - mantissa
    halves = np.clip(values, -_GREATEST_HALF, _GREATEST_HALF).astype(np.float16)
    bits = halves.view(np.uint16).astype(np.int64)
    # Half of the last step that is left, but never up to infinity.
    rounded = np.minimum((bits & 0x7FFF) + ((1 << dropped) >> 1), 0x7BFF) >> dropped
    rounded |= (bits >> 15) << (15 - dropped)
    pack.add(name, rounded, 2, differences=True, dropped=dropped)


def _numbers(values: torch.Tensor) -> Any:
    return values.detach().cpu().double().tolist()
