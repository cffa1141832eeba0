"""Scalars on a mesh, seen through a transfer function."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import torch

from difftetvr.errors import MeshError, shown
from difftetvr.inputs import as_number, as_reals, handed_over, moved, require_type
from difftetvr.mesh import Field, TetMesh
from difftetvr.mesh.field import Location, location_of, require_location
from difftetvr.optics.transfer_function import TransferFunction


@dataclass(frozen=True, eq=False)
class ScalarField:
    """A scalar, linear between vertices or constant in cells, and what it looks like.

    The transfer function is applied to the interpolated scalar everywhere along a ray, not to the vertices' values, so
    its thin features show however coarse the mesh is. Gradients reach the scalars, the knots' values and their places.

    Attributes:
        scalar: (V,) per vertex or (T,) per cell, float32 or float64, finite; may require grad.
        transfer_function: Colour and opacity of scalars in [0, 1].
        attenuation: Density of opacity 1, per unit length, >= 0.
        value_range: Scalars that stand for 0 and 1; None for the least and the greatest one.
        location: "vertex" or "cell"; None lets the length decide, vertices first where both fit.

    Raises:
        MeshError: The scalars are no list of finite numbers, the range is empty, the attenuation is negative, or the
            location is unknown.
    """

    scalar: torch.Tensor
    transfer_function: TransferFunction
    attenuation: float = 1.0
    value_range: tuple[float, float] | None = None
    location: Location | None = None

    def __post_init__(self) -> None:
        scalar = as_reals(self.scalar, "The scalar", MeshError, torch.float64)
        object.__setattr__(self, "scalar", scalar)
        if scalar.dim() != 1 or scalar.shape[0] == 0:
            raise MeshError(f"The scalars have shape {tuple(scalar.shape)}; pass one number for each vertex or cell.")
        if not bool(torch.isfinite(scalar.detach()).all()):
            where = int(torch.nonzero(~torch.isfinite(scalar.detach()))[0])
            raise MeshError(f"Scalar {where} is not finite; correct it or leave its cells out.")
        require_type(
            self.transfer_function,
            TransferFunction,
            "The transfer function",
            "pass a difftetvr.TransferFunction",
            MeshError,
        )
        attenuation = as_number(self.attenuation, "The attenuation", MeshError)
        if not (math.isfinite(attenuation) and attenuation >= 0):
            raise MeshError(f"The attenuation is {attenuation}; it must be finite and not negative.")
        if self.value_range is not None:
            ends = as_reals(
                self.value_range, "The range of the scalars", MeshError, torch.float64, "give two numbers, a tuple"
            )
            if ends.shape != (2,) or not -math.inf < float(ends[0]) < float(ends[1]) < math.inf:
                raise MeshError(
                    f"The range of the scalars is {shown(self.value_range)}; give two numbers, the smaller first."
                )
            object.__setattr__(self, "value_range", tuple(ends.tolist()))
        require_location(self.location, "The location of the scalars")

    def location_on(self, mesh: TetMesh) -> Location:
        """Where on a mesh the scalars live.

        Raises:
            MeshError: Their number is not that of the location.
        """
        count = self.scalar.shape[0]
        return location_of(count, self.location, mesh, f"There are {count} scalars")

    def arrays(self) -> dict[str, torch.Tensor]:
        """What files keep of it, by name: (N,) ``scalar``. The transfer function has files of its own."""
        return {"scalar": self.scalar}

    @property
    def limits(self) -> tuple[float, float]:
        """Scalars that stand for 0 and 1: the range, or the least and the greatest one where none is given."""
        if self.value_range is not None:
            return self.value_range
        low, high = (float(v) for v in torch.aminmax(self.scalar.detach()))
        return low, high

    def normalised(self) -> torch.Tensor:
        """The scalars in units of the range, so that the transfer function's [0, 1] spans it; differentiable."""
        limits = torch.finfo(self.scalar.dtype)
        low, unit, extent = self._span(limits)
        # Infinite ones could not be interpolated; they lie so far outside that it makes no difference.
        return ((unit * self.scalar - unit * low) / extent).nan_to_num(posinf=limits.max / 4, neginf=-limits.max / 4)

    def _span(self, limits: torch.finfo) -> tuple[Any, Any, Any]:
        """The lower end of the range, a unit, and in that the range's extent, 1 where it has none.

        Of the scalars' own range these are tensors, which no host waits for, of a given one numbers, which all devices
        take. The difference of two numbers may overflow, that of their halves, quarters, ... does not.
        """
        given = self.value_range
        low, high = torch.aminmax(self.scalar.detach()) if given is None else torch.tensor(given, dtype=torch.float64)
        exponent = torch.frexp(torch.maximum(low.abs(), high.abs())).exponent
        unit = torch.ldexp(torch.ones_like(low), (math.frexp(limits.max)[1] - 1 - exponent).clamp(max=0))
        extent = torch.where(high > low, (unit * high - unit * low).clamp(min=limits.tiny), 1.0)
        return (low, unit, extent) if given is None else (float(low), float(unit), float(extent))

    def as_field(self) -> Field:
        """Colour and density at the vertices or cells themselves.

        For scalars per cell it is what is rendered. For scalars per vertex it is only an approximation, linear in each
        cell, which every tool can store and draw.
        """
        color, opacity = self.transfer_function(self.normalised())
        return Field(color, self.attenuation * opacity, self.location)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> ScalarField:
        """The same scalars on another device or in another precision; autograd sees them as a function of these.

        Raises:
            MeshError: This machine has no such device.
        """
        return dataclasses.replace(self, scalar=moved(self.scalar, device, dtype, MeshError))

    def knots(self, like: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(K,) scalars and (K, 4) densities and linear RGB of the transfer function; differentiable.

        Args:
            like: Tensor whose precision and device they get.
        """
        function = self.transfer_function
        attenuation = min(self.attenuation, torch.finfo(like.dtype).max)
        scalar, opacity, color = (
            handed_over(part, like) for part in (function.scalar, function.opacity, function.color)
        )
        return scalar, torch.cat((attenuation * opacity[:, None], color), dim=1)
