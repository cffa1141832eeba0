"""Abaqus input files (.inp), of Abaqus and CalculiX: nodes and elements, in the file or in files that it includes."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from difftetvr.errors import MeshError, counted, listed
from difftetvr.mesh.io.content import CellBlock, Content, damaged
from difftetvr.mesh.making.conversion import num_nodes
from difftetvr.trust import file_beside, require_regular

_VOLUMES = {
    4: "tetra",
    5: "pyramid",
    6: "wedge",
    8: "hexahedron",
    10: "tetra10",
    13: "pyramid13",
    15: "wedge15",
    20: "hexahedron20",
    27: "hexahedron27",
}
_SURFACES = {3: "triangle", 4: "quad", 6: "triangle6", 8: "quad8", 9: "quad9"}
_SOLID = re.compile(r"(?:AC|C|DC|DCC|EC|FC|Q)3D(\d+)")
_LAYER = re.compile(r"(?:COH3D|CSS|GK3D|SC)([68])(?![\dL])")
"""Cohesive and gasket elements, continuum and solid shells: wedges and hexahedra, maybe with further nodes behind."""

_SHELL = re.compile(r"(?:DS|M3D|R3D|S|SFM3D|STRI)(\d+)")
_BESIDE = re.compile(
    r"AC2D|ACAX|ASI|B\d|C?AX|CGAX|COH2D|COHAX|CONN|CPE|CPS|DASHPOT|DC2D|DCAX|DS|ELBOW|F2D|F3D|FAX|FRAME|GAP|GK2D|GKAX|"
    r"GKP|HEATCAP|ITS|ITT|JOINT|M3D|MASS|MAX|MCL|MGAX|PIPE|R2D|R3D|RAX|RB|ROTARYI|S\d|SAX|SF|SPRING|STRI|T2D|T3D|W"
)
"""What has no volume: shells, membranes, beams, links, masses, and elements of the plane."""

_GENERATE = ("ELCOPY", "ELGEN", "NCOPY", "NFILL", "NGEN", "NMAP", "SYSTEM")
_DEEPEST, _MOST_FILES, _MOST_NAMES = 16, 1000, 12


@dataclass
class _State:
    """What was read so far.

    Attributes:
        node_rows: Row of a node, by its number; numbers begin anew in each part.
        element_rows: Its number of nodes and nodes' rows, by type and set.
    """

    points: list[list[float]] = field(default_factory=list)
    node_rows: dict[int, int] = field(default_factory=dict)
    elements: dict[tuple[str, str], list[list[int]]] = field(default_factory=dict)
    instances: dict[str, int] = field(default_factory=dict)
    passed_over: dict[str, None] = field(default_factory=dict)


def read(path: Path) -> Content:
    """Read an .inp file.

    Args:
        path: The file; what it includes must lie beside it, or where `difftetvr.trusting` allows.

    Returns:
        Its content; cell data ``abaqus:elset`` numbers the sets that elements are defined in, from 1, 0 for none.

    Raises:
        MeshError: It is damaged, or places or generates parts in a way that is not read.
    """
    state = _State()
    keyword, options, rows = "", dict[str, str](), list[str]()
    for line in _lines(path):
        if not line.startswith("*"):
            rows.append(line)
            continue
        _take(path, state, keyword, options, rows)
        keyword, options = _keyword(line)
        rows = []
    _take(path, state, keyword, options, rows)
    return _content(path, state)


def _lines(path: Path) -> Iterator[str]:
    """Lines without comments and white space; where a file is included, its lines."""
    left = _MOST_FILES

    def lines_of(file: Path, depth: int) -> Iterator[str]:
        nonlocal left
        left -= 1
        if depth > _DEEPEST or left < 0:
            raise damaged(path, "its files include each other without end")
        require_regular(file, MeshError)
        with open(file, encoding="utf-8", errors="replace") as text:
            for line in _whole_lines(text):
                keyword, options = _keyword(line) if line.startswith("*") else ("", {})
                if keyword != "INCLUDE":
                    yield line
                if keyword in ("INCLUDE", "NODE", "ELEMENT") and "INPUT" in options:
                    yield from lines_of(_named(path, file, options["INPUT"]), depth + 1)

    return lines_of(path, 0)


def _whole_lines(text: Iterable[str]) -> Iterator[str]:
    """Lines of one file, those of keywords with the options that follow a comma at their end."""
    begun = ""
    for line in map(str.strip, text):
        if not line or line.startswith("**"):
            continue
        if begun and line[0].isalpha():
            line = begun + line
        elif begun:
            yield begun
        begun = line if line.startswith("*") and line.endswith(",") else ""
        if not begun:
            yield line
    if begun:
        yield begun


def _keyword(line: str) -> tuple[str, dict[str, str]]:
    """The word that a line begins with, and its options by name."""
    words = line[1:].split(",")
    pairs = [word.partition("=") for word in words[1:]]
    return words[0].strip().upper(), {name.strip().upper(): value.strip().strip('"') for name, _, value in pairs}


def _named(path: Path, file: Path, name: str) -> Path:
    """Where a file lies that another one names, relative to the first file or to the one that names it."""
    found = file_beside(path, name, MeshError)
    if not found.is_file() and not Path(name).is_absolute():
        found = file_beside(path, file.parent.resolve() / name, MeshError)
    if not name or not found.is_file():
        raise MeshError(f"{path} includes the file {name[-80:]!r}, which is not there; put it beside it.")
    return found


def _take(path: Path, state: _State, keyword: str, options: dict[str, str], rows: list[str]) -> None:
    """Keeps what a keyword and its rows say."""
    if keyword == "NODE":
        if "SYSTEM" in options and options["SYSTEM"].upper() not in ("", "R"):
            raise MeshError(f"{path} has nodes in cylinders' or spheres' coordinates; write them in Cartesian ones.")
        for row in rows:
            number, _, position = row.partition(",")
            state.node_rows[_whole(path, number)] = len(state.points)
            state.points.append((_numbers(path, position) + [0.0] * 3)[:3])
    elif keyword == "ELEMENT":
        kind = options.get("TYPE", "").upper()
        state.elements.setdefault((kind, options.get("ELSET", "")), []).extend(_elements(path, state, rows))
    elif keyword == "PART":
        state.node_rows = {}
    elif keyword == "INSTANCE":
        part = options.get("PART", "").upper()
        state.instances[part] = state.instances.get(part, 0) + 1
        if rows or state.instances[part] > 1:
            raise MeshError(f"{path} moves or repeats its parts by *INSTANCE; write the assembled mesh as one part.")
    elif keyword in _GENERATE:
        raise MeshError(f"{path} makes nodes or elements by *{keyword}, which is not read; write all of them.")
    elif keyword in ("NSET", "ELSET", "SURFACE"):
        state.passed_over[options.get(keyword, options.get("NAME", ""))[:40]] = None


def _whole(path: Path, word: str) -> int:
    try:
        return int(word)
    except ValueError as error:
        raise damaged(path, f"{word[:40]!r} stands where the number of a node should be") from error


def _numbers(path: Path, row: str) -> list[float]:
    words = row.rstrip(",").upper().replace("D", "E").split(",")  # Fortran writes 1.0D+00
    try:
        return [float(word) if word.strip() else 0.0 for word in words]
    except ValueError as error:
        raise damaged(path, f"{row[:40]!r} stands where numbers should be") from error


def _elements(path: Path, state: _State, rows: list[str]) -> list[list[int]]:
    """Rows of the nodes of each element; a row that ends with a comma goes on in the next."""
    found, words = [], list[str]()
    for row in rows:
        words += [word for word in row.split(",") if word.strip()]
        if row.endswith(","):
            continue
        try:
            found.append([state.node_rows[int(word)] for word in words[1:]])
        except (KeyError, ValueError) as error:
            raise damaged(path, f"the element {words[0][:20].strip()!r} uses a node that is not there") from error
        words = []
    if words:
        raise damaged(path, "its last element is incomplete")
    return found


def _content(path: Path, state: _State) -> Content:
    if not state.points:
        raise damaged(path, "it lacks its nodes")
    sets = [name for name in dict.fromkeys(name for _, name in state.elements) if name]
    parts: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    points, numbers, begin = np.array(state.points), [np.empty(0, np.int64)], 0
    for (kind, name), elements in state.elements.items():
        sizes = {len(nodes) for nodes in elements}
        if len(sizes) > 1:
            raise damaged(path, f"the elements of type {kind[:20]!r} have different numbers of nodes")
        if not elements:
            continue
        rows, nodes = np.arange(begin, begin + len(elements)), np.array(elements, np.int64)
        shape = _name(path, kind, sizes.pop())
        if _LAYER.match(kind):
            nodes = nodes[:, : num_nodes(shape)]
            is_glue = _are_thin(points[nodes])
            parts.setdefault("polygon", []).append((nodes[is_glue], rows[is_glue]))
            nodes, rows = nodes[~is_glue], rows[~is_glue]
        parts.setdefault(shape, []).append((nodes, rows))
        numbers.append(np.full(len(elements), sets.index(name) + 1 if name else 0))
        begin += len(elements)
    blocks = []
    for kind, found in parts.items():
        of_all = np.concatenate([part[1] for part in found])
        is_table = len({nodes.shape[1] for nodes, _ in found}) == 1
        table = np.concatenate([nodes for nodes, _ in found]) if is_table else np.empty((len(of_all), 0), np.int64)
        blocks.append(CellBlock(kind, table, of_all))
    cell_data = {"abaqus:elset": np.concatenate(numbers)} if sets else {}
    return Content(points, tuple(blocks), {}, cell_data, _notes(state, sets))


def _are_thin(corners: np.ndarray) -> np.ndarray:
    """(N,) which layers (N, n, 3) have their upper face where their lower one is, as glue between bodies has."""
    lower, upper = np.split(corners, 2, axis=1)
    return (lower == upper).all((1, 2))


def _name(path: Path, kind: str, size: int) -> str:
    """Name of the kind of an element type; "polygon" for all that has no volume."""
    solid, layer = _SOLID.match(kind), _LAYER.match(kind)
    if solid is None and layer is None:
        return _SURFACES.get(size, "polygon") if _SHELL.match(kind) else "polygon"
    if (solid and int(solid.group(1)) != size) or (layer and int(layer.group(1)) > size):
        raise damaged(path, f"an element of type {kind[:20]!r} has {size} nodes")
    return _VOLUMES[int(layer.group(1))] if layer else _VOLUMES.get(size, kind[:20])


def _unknown(state: _State) -> dict[str, int]:
    """Numbers of elements that may have a volume, but of no shape that is known, by their type."""
    counts: dict[str, int] = {}
    for (kind, _), elements in state.elements.items():
        is_known = any(pattern.match(kind) for pattern in (_SOLID, _LAYER, _BESIDE))
        if not is_known and elements and len(elements[0]) >= 4:
            counts[kind] = counts.get(kind, 0) + len(elements)
    return counts


def _notes(state: _State, sets: list[str]) -> tuple[str, ...]:
    notes = []
    if unknown := _unknown(state):
        words = [f"{counted(number, 'element')} of type {kind[:20]!r}" for kind, number in unknown.items()]
        more = [f"{len(words) - _MOST_NAMES} other types"] if len(words) > _MOST_NAMES else []
        notes.append(f"Left out {listed([*words[:_MOST_NAMES], *more])}, whose shape is not known.")
    if sets:
        said = ", ".join(f"{i + 1} is {name[:40]!r}" for i, name in enumerate(sets[:_MOST_NAMES]))
        notes.append(f"Of the sets in abaqus:elset, {said}{', ...' if len(sets) > _MOST_NAMES else ''}.")
    if others := [name for name in state.passed_over if name not in sets]:
        said = ", ".join(map(repr, others[:_MOST_NAMES]))
        notes.append(f"Left out: the sets {said}{', ...' if len(others) > _MOST_NAMES else ''}.")
    return tuple(notes)
