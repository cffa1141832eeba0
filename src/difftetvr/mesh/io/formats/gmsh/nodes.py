"""Nodes of Gmsh's files: their tags, which are any numbers, and their positions."""

from __future__ import annotations

import numpy as np

from difftetvr.mesh.io.content import as_indices
from difftetvr.mesh.io.source import Source

Nodes = tuple[np.ndarray, np.ndarray]
"""Tags (N,) int64 and positions (N, 3)."""


def read_nodes_2(source: Source) -> Nodes:
    """Nodes of format 2."""
    return tagged(source, source.count(source.words("the number of nodes")[0], "nodes"), 3, "nodes")


def read_nodes_40(source: Source) -> Nodes:
    """Nodes of format 4.0: blocks in which each node's tag precedes it."""
    blocks, total = source.numbers(2, "u8", "numbers of nodes").tolist()
    found = []
    for _ in range(blocks):
        _, dimension, parametric = source.numbers(3, "i4", "blocks of nodes").tolist()
        count = int(source.numbers(1, "u8", "blocks of nodes")[0])
        tags, values = tagged(source, count, 3 + _num_parameters(source, dimension, parametric), "nodes")
        found.append((tags, values[:, :3]))
    return _joined(source, found, total)


def read_nodes_41(source: Source, data_size: int) -> Nodes:
    """Nodes of format 4.1: blocks of all tags, then all nodes."""
    blocks, total, _, _ = source.numbers(4, f"u{data_size}", "numbers of nodes").tolist()
    found = []
    for _ in range(blocks):
        dimension, _, parametric = source.numbers(3, "i4", "blocks of nodes").tolist()
        count = int(source.numbers(1, f"u{data_size}", "blocks of nodes")[0])
        columns = 3 + _num_parameters(source, dimension, parametric)
        tags = signed(source, source.numbers(count, f"u{data_size}", "tags of nodes"))
        found.append((tags, source.numbers(count * columns, "f8", "nodes").reshape(count, columns)[:, :3]))
    return _joined(source, found, total)


def tagged(source: Source, count: int, columns: int, what: str) -> tuple[np.ndarray, np.ndarray]:
    """Rows of a tag and numbers.

    Args:
        source: Where to read.
        count: How many rows.
        columns: How many numbers in each.
        what: What they are, for the sentence.

    Returns:
        (count,) int64 and (count, columns) float64.
    """
    if source.text:
        rows = source.numbers(count * (columns + 1), "f8", what).reshape(count, columns + 1)
        return as_indices(source.path, rows[:, 0]), rows[:, 1:]
    record = np.dtype([("tag", source.order + "i4"), ("values", source.order + "f8", (columns,))])
    records = source.records(count, record, what)
    return records["tag"].astype(np.int64), records["values"].astype(np.float64)


def signed(source: Source, tags: np.ndarray) -> np.ndarray:
    """Tags as int64."""
    if tags.size and tags.max() > 2**62:
        raise source.damaged("a tag is larger than any that there can be")
    return tags.astype(np.int64)


def positions(source: Source, tags: np.ndarray, wanted: np.ndarray, what: str) -> np.ndarray:
    """Where tags stand in a list of tags in any order and with any gaps.

    Args:
        source: The file, for the sentence.
        tags: (N,) the list.
        wanted: Tags to look for.
        what: What is wrong where one is not there.
    """
    order = np.argsort(tags, kind="stable")
    ordered = tags[order]
    if (ordered[1:] == ordered[:-1]).any():
        raise source.damaged("two nodes or elements have one number")
    if not len(tags) and wanted.size:
        raise source.damaged(f"{what} that is not there")
    places = np.searchsorted(ordered, wanted).clip(max=max(len(tags) - 1, 0))
    if (ordered[places] != wanted).any():
        raise source.damaged(f"{what} that is not there")
    return order[places]


def _num_parameters(source: Source, dimension: int, parametric: int) -> int:
    if not 0 <= dimension <= 3:
        raise source.damaged("a block of nodes belongs to nothing")
    return dimension * bool(parametric)


def _joined(source: Source, found: list[Nodes], total: int) -> Nodes:
    if sum(len(tags) for tags, _ in found) != total:
        raise source.damaged("its nodes are not as many as announced")
    tags, vertices = zip(*found) if found else ((np.empty(0, np.int64),), (np.empty((0, 3)),))
    return np.concatenate(tags), np.concatenate(vertices)
