"""Distances of samples in units of length: those that a file gives in several of them, brought to one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from difftetvr.errors import listed

_PREFIXES = {"k": 1e3, "d": 1e-1, "c": 1e-2, "m": 1e-3, "\u00b5": 1e-6, "u": 1e-6, "n": 1e-9, "p": 1e-12}
_INCH = 0.0254
_METRES = {
    "m": 1.0,
    **{f"{prefix}m": factor for prefix, factor in _PREFIXES.items()},
    **dict.fromkeys(("micron", "microns", "micrometer", "micrometers", "micrometre", "micrometres"), 1e-6),
    **dict.fromkeys(("nanometer", "nanometers", "nanometre", "nanometres"), 1e-9),
    **dict.fromkeys(("millimeter", "millimeters", "millimetre", "millimetres"), 1e-3),
    **dict.fromkeys(("centimeter", "centimeters", "centimetre", "centimetres"), 1e-2),
    **dict.fromkeys(("meter", "meters", "metre", "metres"), 1.0),
    **dict.fromkeys(("in", "inch", "inches"), _INCH),
    "\u00c5": 1e-10,
    "thou": _INCH / 1000,
    "li": _INCH / 12,
    "pt": _INCH / 72,
    "ft": 12 * _INCH,
    "yd": 36 * _INCH,
    "mi": 63360 * _INCH,
}
# Greek mu, and the sign of Angstrom, which look like the letters above.
_SAME_LETTERS = str.maketrans("\u03bc\u212b", "\u00b5\u00c5")
_LONGEST_UNIT = 20


class Distances(NamedTuple):
    """Of neighbouring samples along x, y and z, in one unit.

    Attributes:
        values: Three numbers, as parsed.
        notes: What was converted or assumed, a sentence each.
        unit: The unit; empty where it is not known.
    """

    values: tuple[float, float, float]
    notes: tuple[str, ...] = ()
    unit: str = ""


def in_one_unit(
    values: Sequence[float], units: Sequence[str], source: str | Path, unit: str | None = None
) -> Distances:
    """Distances that may have a unit each, in one: only their proportions count, so those of one unit stay as they are.

    Args:
        values: Along x, y and z.
        units: Of each of these.
        source: The file, for the sentences.
        unit: What to convert to where they differ; None: the first one's.
    """
    x, y, z = values
    names = [name.strip().translate(_SAME_LETTERS) for name in units]
    if len(set(names)) == 1:
        return Distances((x, y, z), unit=names[0])
    found = f"The distances of samples in '{source}' are given in {listed(_distinct(names))}"
    lengths = [_METRES.get(name) for name in names]
    common = _METRES.get(unit or names[0])
    factors = [length / common for length in lengths if length is not None and common is not None]
    if len(factors) < 3:
        return Distances(
            (1.0, 1.0, 1.0),
            (f"{found}, which cannot be compared; they are taken as equal, unless --spacing says otherwise.",),
        )
    x, y, z = (value * factor for value, factor in zip(values, factors, strict=True))
    common_unit = unit or names[0]
    note = f"{found}; all are taken in {common_unit}: {x:.6g} x {y:.6g} x {z:.6g}."
    return Distances((x, y, z), (note,), common_unit)


def filled(values: Sequence[float | None], source: str | Path) -> Distances:
    """Distances of which some are not known: these count as the first one that is, or where none is, as 1.

    Args:
        values: Along x, y and z.
        source: The file, for the sentence.
    """
    unknown = [axis for axis, value in zip("xyz", values) if value is None]
    known = [(f"that along {axis}, {value:.6g}", value) for axis, value in zip("xyz", values) if value is not None]
    meaning, first = known[0] if known else ("1", 1.0)
    x, y, z = (first if value is None else value for value in values)
    if not unknown:
        return Distances((x, y, z))
    return Distances(
        (x, y, z),
        (
            f"'{source}' does not tell the distance of samples along {listed(unknown)}; it is taken as {meaning}, "
            "unless --spacing says otherwise.",
        ),
    )


def _distinct(names: Sequence[str]) -> list[str]:
    return [name[:_LONGEST_UNIT] or "no unit" for name in dict.fromkeys(names)]
