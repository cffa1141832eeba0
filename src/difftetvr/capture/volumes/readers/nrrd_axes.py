"""What an NRRD header says of its axes: which of them are space, and where they lead."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import NamedTuple

from difftetvr.capture.volumes.units import filled, in_one_unit
from difftetvr.capture.volumes.volume_file import World, parse_numbers, parse_origin
from difftetvr.errors import CaptureError

_OF_SPACE = ("domain", "space", "none", "???", "")
_LEFT_HANDED = ("left-anterior-superior", "las", "3d-left-handed")
_RAS, _LPS = "right-anterior-superior", "left-posterior-superior"
# What spaces are once those that are left-handed have their first axis reversed.
_SPACES = {
    **{name: name for name in (_RAS, _LPS, "scanner-xyz", "3d-right-handed")},
    "ras": _RAS,
    "lps": _LPS,
    "left-anterior-superior": _RAS,
    "las": _RAS,
    "3d-left-handed": "3d-right-handed",
}


def spatial_axes(path: Path, fields: dict[str, str]) -> list[int]:
    """The three axes of a scalar volume, the fastest first; others are left out where they hold one sample.

    Raises:
        CaptureError: The header disagrees with itself, or describes something else: colours, vectors, time steps.
    """
    sizes, kinds = fields["sizes"].split(), fields.get("kinds", "").split()
    if fields["dimension"] != str(len(sizes)) or (kinds and len(kinds) != len(sizes)):
        raise CaptureError(
            f"The NRRD header of '{path}' has {fields['dimension'][:20]} dimensions but {len(sizes)} sizes and "
            f"{len(kinds)} kinds; get the file anew."
        )
    vectors = _vectors(fields)
    is_space = [
        (kinds[axis] if kinds else "").lower() in _OF_SPACE and (vectors[axis] if axis < len(vectors) else "") != "none"
        for axis in range(len(sizes))
    ]
    axes = list(range(len(sizes)))
    # Axes of one sample say nothing: first those that are no space, then those of a slice of something larger.
    for axis in sorted(axes, key=lambda a: (is_space[a], -a)):
        if len(axes) > 3 and sizes[axis] == "1":
            axes.remove(axis)
    if len(axes) != 3 or not all(is_space[axis] for axis in axes):
        listed = " x ".join(size[:20] for size in sizes)
        kind = f", of the kinds {' '.join(kinds)}" if kinds else ""
        raise CaptureError(
            f"'{path}' has {len(sizes)} dimensions of {listed} values{kind[:120]}, not three of space; give a scalar "
            "volume, such as one channel or one time step of it."
        )
    return axes


class AxisSteps(NamedTuple):
    """Where the axes lead.

    Attributes:
        steps: From a sample to the next along each of the axes, in a right-handed world.
        notes: What was converted or assumed, a sentence each.
        world: Where they begin.
    """

    steps: list[list[float]]
    notes: tuple[str, ...]
    world: World


def axis_steps(path: Path, fields: dict[str, str], axes: list[int]) -> AxisSteps | None:
    """Where the axes lead; None where the header does not say.

    Raises:
        CaptureError: What it says is incomplete.
    """
    space = fields.get("space", "").lower()
    if vectors := _vectors(fields):
        steps = [_vector(word) for word in _chosen(path, vectors, axes)]
        scales, notes, unit = in_one_unit((1.0, 1.0, 1.0), _units(fields, "spaceunits", [0, 1, 2]), path)
        steps = [[scale * part for scale, part in zip(scales, step)] if len(step) == 3 else step for step in steps]
        x, y, z = parse_origin([scale * x for scale, x in zip(scales, _vector(fields.get("spaceorigin", "")))])
    elif "spacings" in fields:
        words = _chosen(path, fields["spacings"].split(), axes)
        steps, notes, unit = _along_axes(path, fields, axes, parse_numbers(words), words)
        x, y, z = _first_of_axes(fields, axes, steps)
    elif "axismins" in fields and "axismaxs" in fields:
        words = [fields["axismins"], "to", fields["axismaxs"]]
        steps, notes, unit = _along_axes(path, fields, axes, _distances(fields, axes), words)
        x, y, z = _first_of_axes(fields, axes, steps)
    else:
        return None
    if space in _LEFT_HANDED:
        steps = [[-step[0], *step[1:]] for step in steps if step]
        x = -x
    return AxisSteps(steps, notes, World((x, y, z), _SPACES.get(space, ""), unit))


def _chosen(path: Path, words: list[str], axes: list[int]) -> list[str]:
    if len(words) <= max(axes):
        raise CaptureError(f"The NRRD header of '{path}' does not tell the distances along all axes; correct it.")
    return [words[axis] for axis in axes]


def _units(fields: dict[str, str], key: str, axes: list[int]) -> list[str]:
    """Names of the units of axes, empty where they are not told."""
    quoted = re.findall(r'"([^"]*)"', fields.get(key, ""))
    return [quoted[axis] if axis < len(quoted) else "" for axis in axes]


def _vectors(fields: dict[str, str]) -> list[str]:
    return re.findall(r"none|\([^()]*\)", fields.get("spacedirections", ""))


def _vector(text: str) -> list[float]:
    return parse_numbers(text.strip("()").split(","))


def _along_axes(
    path: Path, fields: dict[str, str], axes: list[int], distances: list[float], words: list[str]
) -> tuple[list[list[float]], tuple[str, ...], str]:
    """Steps of so many units along x, y and z, notes, and the unit.

    By the format's definition, NaN is a distance that nobody knows.
    """
    if len(distances) != 3:
        given = " ".join(words)[:60]
        raise CaptureError(f"'{path}' gives the sample distances '{given}'; it needs a number for each axis.")
    known = filled([None if math.isnan(distance) else distance for distance in distances], path)
    units = _units(fields, "units", axes)
    told = [unit for unit, distance in zip(units, distances) if not math.isnan(distance)]
    # What is not known has no unit, either.
    units = [told[0] if told and math.isnan(distance) else unit for unit, distance in zip(units, distances)]
    converted = in_one_unit(known.values, units, path)
    steps = [[d if axis == other else 0.0 for other in range(3)] for axis, d in enumerate(converted.values)]
    return steps, (*known.notes, *converted.notes), converted.unit


def _first_of_axes(fields: dict[str, str], axes: list[int], steps: list[list[float]]) -> tuple[float, float, float]:
    """The first sample's place by the least ends of the axes; see `_distances`."""
    lower = parse_numbers(fields.get("axismins", "").split())
    if len(lower) <= max(axes):
        return parse_origin([])
    halves = [0.0 if _is_node(fields, axis) else 0.5 * steps[place][place] for place, axis in enumerate(axes)]
    return parse_origin([lower[axis] + half for axis, half in zip(axes, halves)])


def _distances(fields: dict[str, str], axes: list[int]) -> list[float]:
    """Of samples, by the ends of the axes: those of the outermost cells, or where the header says so, nodes."""
    lower, upper = (parse_numbers(fields[key].split()) for key in ("axismins", "axismaxs"))
    distances = []
    for axis in axes:
        if max(axis + 1, 2) > min(len(lower), len(upper)):
            return []
        intervals = int(fields["sizes"].split()[axis]) - int(_is_node(fields, axis))
        distances.append((upper[axis] - lower[axis]) / max(intervals, 1))
    return distances


def _is_node(fields: dict[str, str], axis: int) -> bool:
    """Whether the first and the last sample lie at the ends of an axis, not in the middle of its outermost cells."""
    centers = (fields.get("centers") or fields.get("centerings") or "").lower().split()
    return axis < len(centers) and centers[axis] == "node"
