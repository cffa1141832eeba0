"""Which numbers of a file to look at: data by name, their components, and what becomes of missing ones."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
import torch

from difftetvr.errors import MeshError, counted
from difftetvr.mesh.arrays import true_indices
from difftetvr.mesh.changes.removal import cells_of
from difftetvr.mesh.field import Location
from difftetvr.mesh.io.loading import MeshData
from difftetvr.mesh.tetmesh import TetMesh

_PLACES: dict[str, Location] = {"point": "vertex", "vertex": "vertex", "cell": "cell"}
_VECTOR = ("x", "y", "z")
_SYMMETRIC = ("xx", "yy", "zz", "xy", "yz", "xz")
_FULL = tuple(a + b for a in _VECTOR for b in _VECTOR)
_AXES = {3: _VECTOR, 6: _SYMMETRIC, 9: _FULL}
"""Names of components by their number, in VTK's order."""

_LARGEST_EXACT = 2**53
"""Up to here float64 holds every integer."""


@dataclass(frozen=True)
class Scalar:
    """One number for each vertex or cell of a mesh, or a vector of them where `array_of` was asked for one.

    Attributes:
        name: What it is called, with its component: ``T``, ``velocity:x``, ``magnitude of velocity``.
        mesh: The mesh; without the cells that have no value.
        values: (V,) or (T,) finite numbers, components in the precision of the file, else float64; (V, C) or (T, C) of
            vectors.
        location: Where they live.
        missing: Number of cells that were left out, as a number of theirs is not finite.
        offset: What was taken off the values: the least of integers that float64 does not hold, such as times in
            nanoseconds; else 0.
        vertices: (V,) int64 rows of the file's point data that are those of the mesh's vertices; None: all, in order.
    """

    name: str
    mesh: TetMesh
    values: torch.Tensor
    location: Location
    missing: int = 0
    offset: int = 0
    vertices: torch.Tensor | None = None

    def counted_from_offset(self, value: float) -> float:
        """A number of the file's as `values` have it, without rounding in between."""
        return float(Fraction(value) - self.offset) if math.isfinite(value) else value


def scalar_of(data: MeshData, name: str | None = None) -> Scalar:
    """A scalar among the data of a file.

    Args:
        data: The file's content.
        name: Name of the data; with ``point:`` or ``cell:`` before it where both have some of that name; with ``:`` and
            a component behind it: a number from 0 on, ``x``, ``y``, ``z`` of vectors, ``xx``, ``xy``, ... of tensors (6
            components: xx yy zz xy yz xz, 9: row by row, as VTK has them), or ``magnitude``, ``trace``, ``von-mises``
            of them. Without one it is the magnitude of a vector or tensor. None: the only data there are.

    Returns:
        The scalar. Cells with a number that is not finite are taken out of the mesh: nothing is known of them, so they
        are as empty as the space around the mesh.

    Raises:
        MeshError: There is no such scalar, several may be meant, or none of its numbers is finite.
    """
    place, base, component, table = _chosen(data, name)
    values, label = _component(table, base, component)
    return _scalar(data, label, values, place)


def array_of(data: MeshData, name: str | None = None) -> Scalar:
    """Data of a file as they are, with all components of vectors and tensors.

    Args:
        data: The file's content.
        name: As for `scalar_of`; without a component it means all of them.

    Returns:
        The numbers. Cells with one that is not finite are taken out of the mesh.

    Raises:
        MeshError: As for `scalar_of`.
    """
    place, base, component, table = _chosen(data, name)
    if component is None:
        return _scalar(data, base, table, place)
    values, label = _component(table, base, component)
    return _scalar(data, label, values, place)


def array_names(data: MeshData) -> list[str]:
    """Names of all data of a file, by which `array_of` finds each."""
    found = _candidates(data)
    return [_label(place, name, found) for place, name in found]


def _chosen(data: MeshData, name: str | None) -> tuple[Location, str, str | None, torch.Tensor]:
    """Place, name, wanted component and numbers of the data that a name means."""
    found = _candidates(data)
    if not found:
        raise MeshError("there are no scalars to show; add point or cell data, or color and density.")
    names = ", ".join(sorted({_label(place, n, found) for place, n in found}))
    if name is not None:
        place, base, component = _parsed(name, found, names)
        return place, base, component, found[place, base]
    if len(found) > 1:
        raise MeshError(f"there are several scalars ({names}); choose one with --scalar.")
    ((place, base), table) = next(iter(found.items()))
    return place, base, None, table


def _scalar(data: MeshData, label: str, values: torch.Tensor, place: Location) -> Scalar:
    numbers, offset = _numbers(values)
    return _without_missing(Scalar(label, data.mesh, numbers, place, offset=offset))


def _candidates(data: MeshData) -> dict[tuple[Location, str], torch.Tensor]:
    """Arrays by place and name that hold numbers, vectors or tensors."""
    places: tuple[tuple[Location, dict[str, torch.Tensor]], ...] = (
        ("vertex", data.point_data),
        ("cell", data.cell_data),
    )
    return {(place, n): v.flatten(1) if v.dim() > 1 else v for place, arrays in places for n, v in arrays.items()}


def _label(place: Location, name: str, found: dict[tuple[Location, str], torch.Tensor]) -> str:
    other: Location = "cell" if place == "vertex" else "vertex"
    return f"{'point' if place == 'vertex' else 'cell'}:{name}" if (other, name) in found else name


def _parsed(name: str, found: dict[tuple[Location, str], torch.Tensor], names: str) -> tuple[Location, str, str | None]:
    """Place, name of the data and component that a name means; names may hold colons themselves."""
    readings: list[tuple[list[Location], str]] = [(["vertex", "cell"], name)]
    prefix, _, rest = name.partition(":")
    if prefix in _PLACES and rest:
        readings.append(([_PLACES[prefix]], rest))
    for places, text in readings:
        base, _, component = text.rpartition(":")
        for wanted, part in ((text, None), (base, component)):
            hits: list[Location] = [place for place in places if (place, wanted) in found]
            if len(hits) > 1:
                raise MeshError(
                    f"both its points and its cells have data '{wanted}'; choose with --scalar 'point:{name}' or "
                    f"'cell:{name}'."
                )
            if hits:
                return hits[0], wanted, part
    raise MeshError(f"there is no scalar '{name}' (found: {names}); name one of these with --scalar.")


def _component(values: torch.Tensor, base: str, component: str | None) -> tuple[torch.Tensor, str]:
    """(N,) numbers of a component, and what to call it."""
    columns = values[:, None] if values.dim() == 1 else values
    count = columns.shape[1]
    if component is None:
        if count == 1:
            return columns[:, 0], base
        return _invariant(_length, columns), f"magnitude of {base}"
    axes = _AXES.get(count, ())
    if component.isascii() and component.isdigit() and int(component) < count:
        return columns[:, int(component)], f"{base}:{component}"
    if component in axes:
        return columns[:, axes.index(component)], f"{base}:{component}"
    invariants: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {"magnitude": _length} if count > 1 else {}
    if count in (6, 9):
        invariants |= {"trace": _trace, "von-mises": _von_mises}
    if component in invariants:
        return _invariant(invariants[component], columns), f"{component} of {base}"
    known = ", ".join((f"0 to {count - 1}" if count > 1 else "0", *axes, *invariants))
    raise MeshError(f"'{base}' has no component '{component}'; its components are {known}.")


def _numbers(values: torch.Tensor) -> tuple[torch.Tensor, int]:
    """Floating-point numbers, and what was taken off them: the least of integers that float64 would round."""
    if values.is_floating_point():
        return values, 0
    integers = values.numpy()
    least, greatest = int(integers.min()), int(integers.max())
    if max(-least, greatest) <= _LARGEST_EXACT:
        return values.double(), 0
    # Modulo 2^64, in which no difference overflows.
    above = integers.astype(np.uint64) - np.uint64(least % 2**64)
    return torch.from_numpy(above.astype(np.float64)), least


def _invariant(of_tensors: Callable[[torch.Tensor], torch.Tensor], columns: torch.Tensor) -> torch.Tensor:
    """(N,) float64 numbers that grow as their tensors do, of which no square overflows or underflows."""
    exact = columns.double()
    largest = exact.abs().amax(1)
    size = torch.where(largest > 0, largest, 1.0)
    return size * of_tensors(exact / size[:, None])


def _length(columns: torch.Tensor) -> torch.Tensor:
    """Euclidean or Frobenius norm; off the diagonal, symmetric tensors hold each number that counts twice once."""
    weights = columns.new_ones(columns.shape[1])
    if columns.shape[1] == len(_SYMMETRIC):
        weights[3:] = 2.0
    return (columns.square() * weights).sum(1).sqrt()


def _trace(columns: torch.Tensor) -> torch.Tensor:
    return sum(columns[:, i] for i in _diagonal(columns))  # type: ignore[return-value]


def _von_mises(columns: torch.Tensor) -> torch.Tensor:
    """sqrt(3/2 s : s) of the deviator s, for 9 components that of the symmetric part."""
    x, y, z = (columns[:, i] for i in _diagonal(columns))
    if columns.shape[1] == len(_SYMMETRIC):
        xy, yz, xz = columns[:, 3:].unbind(1)
    else:
        xy, yz, xz = (0.5 * (columns[:, a] + columns[:, b]) for a, b in ((1, 3), (5, 7), (2, 6)))
    normal = 0.5 * ((x - y).square() + (y - z).square() + (z - x).square())
    return (normal + 3.0 * (xy.square() + yz.square() + xz.square())).sqrt()


def _diagonal(columns: torch.Tensor) -> tuple[int, int, int]:
    return (0, 1, 2) if columns.shape[1] == len(_SYMMETRIC) else (0, 4, 8)


def _without_missing(scalar: Scalar) -> Scalar:
    finite = torch.isfinite(scalar.values)
    finite = finite.all(1) if finite.dim() > 1 else finite
    if finite.all():
        return scalar
    mesh = scalar.mesh
    kept = finite if scalar.location == "cell" else finite[mesh.tets.long()].all(1)
    if not kept.any():
        raise MeshError(f"the scalar '{scalar.name}' is finite in no cell; name another with --scalar.")
    rest, used = cells_of(mesh, true_indices(kept))
    values = scalar.values[kept] if scalar.location == "cell" else scalar.values[used]
    return replace(scalar, mesh=rest, values=values, missing=int((~kept).sum()), vertices=used)


def missing_note(scalar: Scalar) -> str | None:
    """What to say of cells that were left out; None where none was."""
    if not scalar.missing:
        return None
    cells = counted(scalar.missing, "cell")
    return (
        f"'{scalar.name}' has no finite value in {cells}, which {'is' if scalar.missing == 1 else 'are'} transparent."
    )
