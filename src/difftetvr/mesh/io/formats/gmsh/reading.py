"""From Gmsh's files to contents: sections in turn, then what they are together."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from difftetvr.errors import MeshError
from difftetvr.mesh.io.content import CellBlock, Content
from difftetvr.mesh.io.formats.gmsh.data import PLACES, Views, at_nodes, spread
from difftetvr.mesh.io.formats.gmsh.elements import Elements, joined, read_elements_2, read_elements_4
from difftetvr.mesh.io.formats.gmsh.entities import Groups, read_entities, read_names, read_partitioned_entities
from difftetvr.mesh.io.formats.gmsh.nodes import Nodes, positions, read_nodes_2, read_nodes_40, read_nodes_41
from difftetvr.mesh.io.source import Source


@dataclass(frozen=True)
class _Format:
    """Version of a file: 2, 4.0 or 4.1; and how many bytes its counts have, None where the version fixes it."""

    version: str
    data_size: int | None


@dataclass
class _Mesh:
    """Nodes, and the elements that follow them."""

    nodes: Nodes
    elements: list[Elements] = field(default_factory=list)

    def equals(self, other: _Mesh) -> bool:
        """Whether it is another one once more."""
        mine, others = joined(self.elements), joined(other.elements)
        pairs = list(zip(self.nodes, other.nodes))
        pairs += [pair for a, b in zip(mine, others) for pair in ((a.tags, b.tags), (a.nodes, b.nodes))]
        return [e.kind for e in mine] == [e.kind for e in others] and all(np.array_equal(a, b) for a, b in pairs)


@dataclass
class _State:
    """What was read so far."""

    meshes: list[_Mesh] = field(default_factory=list)
    groups: Groups = field(default_factory=Groups)
    views: Views = field(default_factory=Views)


def read(path: Path, step: int | None = None) -> Content:
    """Read a .msh file.

    Args:
        path: The file.
        step: Of the data; see `chosen_step`.

    Returns:
        Its content. ``gmsh:physical`` and ``gmsh:geometrical`` are cell data where the elements have such: the first
        physical group of a cell, 0 where it has none, and its entity. Element data are NaN for elements that the file
        has none for; data of each node of each element are averaged at nodes.

    Raises:
        MeshError: The file is damaged, of another version, or holds several meshes.
    """
    with open(path, "rb") as file:
        source = Source(path, file)
        state = _State()
        form = _read_format(source, _first_line(source))
        while (line := source.next_line()) is not None:
            if not line.startswith("$"):
                raise source.damaged(f"{line[:40]!r} stands where a section should begin")
            if line == "$MeshFormat":  # files that Gmsh appends to begin anew
                form = _read_format(source, line)
            else:
                _read_section(source, state, line[1:], form)
    return _content(source, state, form, step)


def _first_line(source: Source) -> str:
    line = source.next_line() or ""
    while line == "$Comments":
        source.until(b"$EndComments", "comments")
        line = source.next_line() or ""
    if line.startswith("("):
        raise MeshError(f"{source.path} is a mesh of ANSYS Fluent, not of Gmsh; open it in ParaView, save it as .vtu.")
    if line == "$NOD":
        raise MeshError(f"{source.path} is of Gmsh's format 1; save it again in format 4.1 or 2.2.")
    return line


def _read_format(source: Source, line: str) -> _Format:
    words = source.words("the format", 3) if line == "$MeshFormat" else []
    if not words or words[1] not in ("0", "1"):
        raise source.damaged("it does not begin as Gmsh's files do")
    version = "2" if words[0].startswith("2") else "4.0" if words[0] == "4" else words[0]
    if version not in ("2", "4.0", "4.1"):
        raise MeshError(f"{source.path} is of Gmsh's format {words[0][:20]}; save it again in format 4.1 or 2.2.")
    source.text = words[1] == "0"
    if not source.text:
        one = source.take(4, "the mark of the byte order")
        if one not in (b"\1\0\0\0", b"\0\0\0\1"):
            raise source.damaged("the mark of the byte order is missing")
        source.order = "<" if one[0] else ">"
    source.until(b"$EndMeshFormat", "the format")
    if words[2] not in ("4", "8"):
        raise source.damaged(f"its numbers have {words[2][:20]!r} bytes")
    return _Format(version, int(words[2]) if version == "4.1" else None)


def _read_section(source: Source, state: _State, name: str, form: _Format) -> None:
    size = form.data_size
    if name == "Nodes":
        if form.version == "2":
            nodes = read_nodes_2(source)
        else:
            nodes = read_nodes_40(source) if size is None else read_nodes_41(source, size)
        state.meshes.append(_Mesh(nodes))
    elif name == "Elements":
        if not state.meshes:
            raise source.damaged("its elements come before its nodes")
        state.meshes[-1].elements += read_elements_2(source) if form.version == "2" else read_elements_4(source, size)
    elif name == "PhysicalNames":
        read_names(source, state.groups)
    elif name == "Entities" and form.version != "2":
        read_entities(source, state.groups, size)
    elif name == "PartitionedEntities" and form.version != "2":
        read_partitioned_entities(source, state.groups, size)
    elif name in PLACES:
        state.views.read(source, name)
    source.until(b"$End" + name.encode(), f"the section {name[:40]!r} does")


def _content(source: Source, state: _State, form: _Format, step: int | None) -> Content:
    mesh = _only_mesh(source, state)
    node_tags, vertices = mesh.nodes
    elements = joined(mesh.elements)
    found: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    begin = 0
    for e in elements:
        nodes = positions(source, node_tags, e.nodes, "an element uses a node")
        found.setdefault(e.kind, []).append((nodes, np.arange(begin, begin + len(nodes))))
        begin += len(nodes)
    blocks = [CellBlock(kind, *map(np.concatenate, zip(*parts))) for kind, parts in found.items()]
    point_data: dict[str, np.ndarray] = {}
    cell_data, notes = _groups(state.groups, elements, form)
    tags = np.concatenate([np.empty(0, np.int64), *(e.tags for e in elements)])
    for view in state.views.chosen(source.path, step):
        records = next(iter(view.records.values()))
        if view.place == "NodeData":
            point_data[view.name] = spread(source, node_tags, records, "data belong to a node")
        elif view.place == "ElementData":
            cell_data[view.name] = spread(source, tags, records, "data belong to an element")
        else:
            values, differ = at_nodes(source, node_tags, elements, records)
            name = view.name if view.name not in point_data else f"{view.name} (elements' nodes)"
            point_data[name] = values
            if differ:
                notes.append(f"Averaged {view.name[:80]!r} at vertices, as each cell has its own values at its nodes.")
    notes += state.views.notes
    return Content(vertices, tuple(blocks), point_data, cell_data, tuple(notes), state.groups.names_of_volumes)


def _only_mesh(source: Source, state: _State) -> _Mesh:
    """The mesh of a file, which may be there several times."""
    if not state.meshes and state.views.names:
        names = ", ".join(repr(name[:40]) for name in state.views.names[:8])
        raise MeshError(
            f"{source.path} holds data ({names}) without their mesh, which lies in another file; merge both in Gmsh "
            "and save them into one."
        )
    if not state.meshes:
        raise source.damaged("it lacks its nodes")
    first = state.meshes[0]
    if not all(mesh.equals(first) for mesh in state.meshes[1:]):
        raise MeshError(
            f"{source.path} holds {len(state.meshes)} meshes that differ; save each into a file of its own, or "
            "merge them."
        )
    return first


def _groups(groups: Groups, elements: list[Elements], form: _Format) -> tuple[dict[str, np.ndarray], list[str]]:
    """Cell data of groups, and sentences about them.

    In format 2 these are what elements name, each as many as it likes; in format 4 they follow from the entities.
    """
    are_volumes = [e.kind.startswith(("tetra", "hexahedron", "wedge", "pyramid")) for e in elements]
    columns = max((e.groups.shape[1] for e, is_volume in zip(elements, are_volumes) if is_volume), default=0)
    if not columns:
        return {}, []
    tables = [np.pad(e.groups[:, :columns], ((0, 0), (0, max(columns - e.groups.shape[1], 0)))) for e in elements]
    table = np.concatenate(tables)
    inner = np.concatenate([part for part, is_volume in zip(tables, are_volumes) if is_volume])
    if form.version == "2":
        names = ("gmsh:physical", "gmsh:geometrical")[: table.shape[1]]
        # A physical group of 0 is none, and one of the two tags that most programs insist on.
        found = {name: table[:, i] for i, name in enumerate(names) if i or table[:, i].any()}
        return found, groups.notes(set(inner[:, 0].tolist()), set())
    found = {"gmsh:geometrical": table[:, 1]}
    if groups.physical and (physical := groups.of(table)).any():
        found = {"gmsh:physical": physical, **found}
        entities = {(d, tag) for d, tag in np.unique(inner, axis=0).tolist()}
        return found, groups.notes(set(groups.of(inner).tolist()), entities)
    return found, []
