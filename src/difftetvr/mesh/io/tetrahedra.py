"""The tetrahedra of a file's content, whatever kinds of cells it has."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from difftetvr.errors import MeshError, counted
from difftetvr.mesh.io.building import Request, Tets
from difftetvr.mesh.io.content import CellBlock, Content, require_array
from difftetvr.mesh.making.conversion import PIECES, is_convertible, is_curved, linear_kind, num_nodes, to_tetrahedra

# What commonly lies beside the volume cells in a file and bounds them; it carries no volume.
_LOWER_DIMENSIONAL = ("vertex", "line", "triangle", "quad", "polygon", "pixel", "empty", "poly_")


def tetrahedra_of(request: Request, content: Content) -> Tets:
    """The tetrahedra that a file holds, or that fill its cells.

    Args:
        request: The file, and whether other cells are to be made tetrahedra.
        content: What it holds.

    Raises:
        MeshError: There are none, cells of other kinds that are not to be split or cannot be, or indices out of range.
    """
    path, split = request.path, request.split
    volumes = [b for b in content.cells if len(b.nodes) and not b.kind.startswith(_LOWER_DIMENSIONAL)]
    if not volumes and content.hidden:
        raise MeshError(
            f"All {counted(content.hidden, 'cell')} of {path} are marked as hidden or as another piece's; give the "
            "whole mesh, or another time step."
        )
    if not volumes:
        found = ", ".join(sorted({block.kind for block in content.cells})) or "no cells"
        raise MeshError(f"{path} holds no tetrahedra (found: {found}); give a tetrahedral volume mesh.")
    counts: Counter[str] = Counter()
    for block in volumes:
        counts[block.kind] += len(np.unique(block.rows)) if block.kind == PIECES else len(block.rows)
    _require_convertible(path, counts, split)
    nodes, rows = [], []
    for block in volumes:
        _require_valid_nodes(path, block, len(content.vertices))
        pieces, parents = to_tetrahedra(block.kind, block.nodes.astype(np.int64))
        nodes.append(pieces)
        rows.append(block.rows[parents])
    curved = {kind: count for kind, count in counts.items() if is_curved(kind)}
    notes = [f"Straightened {_listed(curved)}; what nodes other than corners hold was left out."] if curved else []
    if split is None and (divided := _named(counts)):
        made = sum(len(part) for block, part in zip(volumes, nodes, strict=True) if linear_kind(block.kind) != "tetra")
        notes.append(f"Split {divided} into {made:,} tetrahedra.")
    return Tets(np.concatenate(nodes), np.concatenate(rows), (*content.notes, *notes))


def _listed(counts: Mapping[str, int]) -> str:
    """Cells of several kinds, in words: 8 cells of type 'hexahedron' and 2 of type 'wedge'."""
    (kind, count), *others = sorted(counts.items())
    return _joined([f"{counted(count, 'cell')} of type '{kind}'", *(f"{n:,} of type '{name}'" for name, n in others)])


def _named(counts: Mapping[str, int]) -> str:
    """Cells other than tetrahedra, in words and whatever their order: 8 hexahedra and 2 wedges."""
    sums: Counter[str] = Counter()
    for kind, count in counts.items():
        sums[linear_kind(kind)] += count
    return _joined(
        [
            counted(count, kind, kind.removesuffix("on") + "a" if kind.endswith("hedron") else None)
            for kind, count in sorted(sums.items())
            if kind != "tetra"
        ]
    )


def _joined(words: list[str]) -> str:
    return f"{', '.join(words[:-1])} and {words[-1]}" if len(words) > 1 else "".join(words)


def _require_convertible(path: Path, counts: Mapping[str, int], split: bool | None) -> None:
    strange = {kind: count for kind, count in counts.items() if not is_convertible(kind)}
    if strange:
        raise MeshError(
            f"{path} holds {_listed(strange)}, which cannot be split into tetrahedra; tetrahedralise it first."
        )
    others = {kind: count for kind, count in counts.items() if kind != "tetra"}
    if others and split is False:
        raise MeshError(
            f"{path} holds {_listed(others)}; only linear tetrahedra are taken here, so make them with "
            "difftetvr export --split, or load with split=True."
        )


def _require_valid_nodes(path: Path, block: CellBlock, num_vertices: int) -> None:
    require_array(path, f"cells of type '{block.kind}'", block.nodes, num_nodes(block.kind), "iu")
    outside = (block.nodes < 0) | (block.nodes >= num_vertices)
    if outside.any():
        row, column = np.argwhere(outside)[0]
        raise MeshError(
            f"{path}: Cell {block.rows[row]}: its vertex index {block.nodes[row, column]} is out of range; the mesh "
            f"has {num_vertices} vertices, so indices go from 0 to {num_vertices - 1}."
        )
