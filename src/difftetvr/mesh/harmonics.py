"""Real spherical harmonics: colours that depend on the direction they are seen from (Dr.Jit kernels)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch
from torch.autograd.function import once_differentiable

from difftetvr.backend import Backend, backend_for
from difftetvr.memory import tried_twice
from difftetvr.mesh.shapes import dot
from difftetvr.recording import few_lengths, replayed

COUNTS = (0, 3, 8, 15)
"""Number of functions in the bands 1 to each degree."""

# Factors that make the functions orthonormal.
_A = 0.4886025119029199
_B, _C = 1.0925484305920792, 0.31539156525252005
_D, _E, _F, _G = 0.5900435899266435, 1.445305721320277, 0.4570457994644658, 0.3731763325901154

_NOWHERE = 1e-12
"""Length up to which a vector has no direction, as for :func:`torch.nn.functional.normalize`."""


def harmonic_basis(directions: torch.Tensor, degree: int) -> torch.Tensor:
    """Orthonormal real spherical harmonics of the bands 1 to ``degree``, band 0 left out.

    In each band they are ordered from order -l to l and have the signs that 3-D Gaussian splatting uses (those of
    Condon and Shortley). Differentiable.

    Args:
        directions: (N, 3) unit vectors.
        degree: From 0 to 3.

    Returns:
        (N, 0), (N, 3), (N, 8) or (N, 15).
    """
    functions = _functions(directions.unbind(dim=1), degree)
    return torch.stack(functions, dim=1) if functions else directions.new_zeros(directions.shape[0], 0)


def seen_colors(color: torch.Tensor, harmonics: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    """Colours as they are seen in some directions, cut off at 0.

    Differentiable once in all arguments.

    Args:
        color: (N, 3) the same from all sides; float32 or float64, which is the precision of the result.
        harmonics: (N, B, 3) coefficients that are added, with B one of :data:`COUNTS`, not 0.
        vectors: (N, 3) from the eye to each place, or (1, 3) for all of them; of any length, but the direction of none
            that is all but 0 is known.

    Returns:
        (N, 3).
    """
    if not len(color):
        return color
    harmonics, vectors = harmonics.to(color), vectors.to(color).expand(len(color), 3)
    seen: torch.Tensor = _SeenColors.apply(color, harmonics, vectors)
    return seen


class _SeenColors(torch.autograd.Function):
    """From colours, coefficients and vectors to the colours that are seen."""

    @staticmethod
    def forward(ctx: Any, *tensors: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(*tensors)
        source = _Source.of(*tensors)
        with source.backend.exclusive():
            seen = replayed(_see, source, few_lengths(len(tensors[0])))
            return source.backend.tensor(seen, -1, 3)[: len(tensors[0])]

    @staticmethod
    @once_differentiable
    @tried_twice
    def backward(ctx: Any, by_seen: torch.Tensor) -> Any:
        color, harmonics, vectors = ctx.saved_tensors
        count, source = len(color), _Source.of(color, harmonics, vectors)
        backend = source.backend
        with backend.exclusive():
            found = replayed(_see_backward, source, backend.floats(by_seen), few_lengths(count), *ctx.needs_input_grad)
            return tuple(
                None if part is None else backend.tensor(part).view(-1, *like.shape[1:])[:count]
                for part, like in zip(found, (color, harmonics, vectors), strict=True)
            )


# ---- Kernels


@dataclass
class _Source:
    """Colours and directions, flat.

    Attributes:
        backend: Array types.
        degree: Of the harmonics.
        lanes: (N,) numbers of the colours.
        color: (N, 3).
        harmonics: (N, B, 3).
        vectors: (N, 3).
    """

    backend: Backend
    degree: int
    lanes: Any
    color: Any
    harmonics: Any
    vectors: Any

    @staticmethod
    def of(color: torch.Tensor, harmonics: torch.Tensor, vectors: torch.Tensor) -> _Source:
        backend = backend_for(color)
        degree, lanes = COUNTS.index(harmonics.shape[1]), backend.lanes(len(color))
        return _Source(backend, degree, lanes, *map(backend.floats, (color, harmonics, vectors)))

    def direction(self) -> tuple[list[Any], Any]:
        """Unit vectors, and one over what they were divided by."""
        vector = self.row(self.vectors, 3)
        scale = 1.0 / dr.fmax(dr.sqrt(dot(vector, vector)), _NOWHERE)
        return [scale * part for part in vector], scale

    def coefficients(self) -> list[list[Any]]:
        """Of each function the three of a colour."""
        row = self.row(self.harmonics, 3 * COUNTS[self.degree])
        return [row[first : first + 3] for first in range(0, len(row), 3)]

    def colors(self, basis: list[Any], coefficients: list[list[Any]]) -> list[Any]:
        """What is seen, not yet cut off."""
        seen = self.row(self.color, 3)
        for function, three in zip(basis, coefficients, strict=True):
            seen = [dr.fma(function, part, so_far) for part, so_far in zip(three, seen, strict=True)]
        return seen

    def row(self, array: Any, width: int) -> list[Any]:
        """Of (N, W) numbers those of each colour."""
        return [dr.gather(self.backend.Float, array, width * self.lanes + k) for k in range(width)]


def _see(source: _Source, length: int) -> Any:
    """Flat (length, 3) colours, for :func:`difftetvr.recording.replayed`."""
    basis = _functions(source.direction()[0], source.degree)
    # What is not finite stays what it is, for somebody to find.
    unlimited = source.colors(basis, source.coefficients())
    colors = [dr.select((part < 0) & dr.isfinite(part), 0, part) for part in unlimited]
    seen = _written(source, colors, length)
    dr.eval(seen)
    return seen


def _see_backward(
    source: _Source, by_seen: Any, length: int, needs_color: bool, needs_harmonics: bool, needs_vectors: bool
) -> tuple[Any | None, ...]:
    """Flat derivatives by colours, coefficients and vectors, likewise; None where not wanted."""
    direction, scale = source.direction()
    coefficients, basis = source.coefficients(), _functions(direction, source.degree)
    seen = source.colors(basis, coefficients)
    derivative = [dr.select(part < 0, 0, by) for part, by in zip(seen, source.row(by_seen, 3), strict=True)]
    by_coefficients = [function * by for function in basis for by in derivative]
    by_direction = [source.backend.Float(0)] * 3
    for three, slopes in zip(coefficients, _slopes(direction, source.degree), strict=True):
        weight = dot(three, derivative)
        by_direction = [dr.fma(weight, slope, so_far) for slope, so_far in zip(slopes, by_direction, strict=True)]
    along = dot(direction, by_direction)
    by_vector = [scale * (by - along * part) for part, by in zip(direction, by_direction, strict=True)]
    wanted = ((derivative, needs_color), (by_coefficients, needs_harmonics), (by_vector, needs_vectors))
    found = tuple(_written(source, row, length) if is_wanted else None for row, is_wanted in wanted)
    dr.eval(*found)
    return found


def _written(source: _Source, row: list[Any], length: int) -> Any:
    """Flat (length, W) of W numbers each."""
    array = dr.empty(source.backend.Float, len(row) * length)
    dr.scatter(array, source.backend.Floats(row), source.lanes)
    return array


def _functions(direction: Sequence[Any], degree: int) -> list[Any]:
    """The functions of :func:`harmonic_basis`, on arrays of any kind."""
    x, y, z = direction
    functions: list[Any] = []
    if degree >= 1:
        functions += [-_A * y, _A * z, -_A * x]
    xx, yy, zz = x * x, y * y, z * z
    if degree >= 2:
        functions += [_B * x * y, -_B * y * z, _C * (2.0 * zz - xx - yy), -_B * x * z, 0.5 * _B * (xx - yy)]
    if degree >= 3:
        functions += [
            -_D * y * (3.0 * xx - yy),
            2.0 * _E * x * y * z,
            -_F * y * (4.0 * zz - xx - yy),
            _G * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
            -_F * x * (4.0 * zz - xx - yy),
            _E * z * (xx - yy),
            -_D * x * (xx - 3.0 * yy),
        ]
    return functions


def _slopes(direction: Sequence[Any], degree: int) -> list[tuple[Any, Any, Any]]:
    """Derivatives of the same polynomials by x, y and z."""
    x, y, z = direction
    slopes: list[tuple[Any, Any, Any]] = []
    if degree >= 1:
        slopes += [(0.0, -_A, 0.0), (0.0, 0.0, _A), (-_A, 0.0, 0.0)]
    if degree >= 2:
        slopes += [
            (_B * y, _B * x, 0.0),
            (0.0, -_B * z, -_B * y),
            (-2.0 * _C * x, -2.0 * _C * y, 4.0 * _C * z),
            (-_B * z, 0.0, -_B * x),
            (_B * x, -_B * y, 0.0),
        ]
    if degree >= 3:
        xx, yy, zz = x * x, y * y, z * z
        slopes += [
            (-6.0 * _D * x * y, -3.0 * _D * (xx - yy), 0.0),
            (2.0 * _E * y * z, 2.0 * _E * x * z, 2.0 * _E * x * y),
            (2.0 * _F * x * y, -_F * (4.0 * zz - xx - 3.0 * yy), -8.0 * _F * y * z),
            (-6.0 * _G * x * z, -6.0 * _G * y * z, 3.0 * _G * (2.0 * zz - xx - yy)),
            (-_F * (4.0 * zz - 3.0 * xx - yy), 2.0 * _F * x * y, -8.0 * _F * x * z),
            (2.0 * _E * x * z, -2.0 * _E * y * z, _E * (xx - yy)),
            (-3.0 * _D * (xx - yy), 6.0 * _D * x * y, 0.0),
        ]
    return slopes
