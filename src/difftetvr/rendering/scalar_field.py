"""Scalars on a mesh, seen through a transfer function."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import torch

from difftetvr.errors import MeshError, shown
from difftetvr.mesh import Field, TetMesh
from difftetvr.mesh.field import Location
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
        scalar = self.scalar
        if not isinstance(scalar, torch.Tensor) or not scalar.is_floating_point():
            scalar = torch.as_tensor(scalar, dtype=torch.float64)
            object.__setattr__(self, "scalar", scalar)
        if scalar.dim() != 1 or scalar.shape[0] == 0:
            raise MeshError(f"The scalars have shape {tuple(scalar.shape)}; pass one number for each vertex or cell.")
        if not bool(torch.isfinite(scalar.detach()).all()):
            where = int(torch.nonzero(~torch.isfinite(scalar.detach()))[0])
            raise MeshError(f"Scalar {where} is not finite; correct it or leave its cells out.")
        if not (math.isfinite(self.attenuation) and self.attenuation >= 0):
            raise MeshError(f"The attenuation is {shown(self.attenuation)}; it must be finite and not negative.")
        if self.value_range is not None:
            try:
                low, high = (float(value) for value in self.value_range)
            except (TypeError, ValueError):
                low, high = math.nan, math.nan
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                raise MeshError(
                    f"The range of the scalars is {shown(self.value_range)}; give two numbers, the smaller first."
                )
        if self.location not in (None, "vertex", "cell"):
            raise MeshError(f'The location of the scalars is {self.location!r}; pass "vertex", "cell" or None.')

    def location_on(self, mesh: TetMesh) -> Location:
        """Where on a mesh the scalars live.

        Raises:
            MeshError: Their number is not that of the location.
        """
        counts: dict[Location, int] = {"vertex": mesh.num_vertices, "cell": mesh.num_cells}
        candidates: tuple[Location, ...] = ("vertex", "cell") if self.location is None else (self.location,)
        for location in candidates:
            if self.scalar.shape[0] == counts[location]:
                return location
        wanted = " or ".join(f"{counts[location]} for one per {location}" for location in candidates)
        raise MeshError(f"There are {self.scalar.shape[0]} scalars, but this mesh needs {wanted}.")

    def arrays(self) -> dict[str, torch.Tensor]:
        """What files keep of it, by name: (N,) ``scalar``. The transfer function has files of its own."""
        return {"scalar": self.scalar}

    def normalised(self) -> torch.Tensor:
        """The scalars in units of the range, so that the transfer function's [0, 1] spans it; differentiable."""
        low, high = self.value_range or (float(v) for v in torch.aminmax(self.scalar.detach()))
        return (self.scalar - low) / (high - low if high > low else 1.0)

    def as_field(self) -> Field:
        """Colour and density at the vertices or cells themselves.

        For scalars per cell it is what is rendered. For scalars per vertex it is only an approximation, linear in each
        cell, which every tool can store and draw.
        """
        color, opacity = self.transfer_function(self.normalised())
        return Field(color, self.attenuation * opacity, self.location)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> ScalarField:
        """The same scalars on another device or in another precision; autograd sees them as a function of these."""
        return dataclasses.replace(self, scalar=self.scalar.to(device=device, dtype=dtype))

    def knots(self, like: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(K,) scalars and (K, 4) densities and linear RGB of the transfer function; differentiable.

        Args:
            like: Tensor whose precision and device they get.
        """
        function = self.transfer_function
        density = self.attenuation * function.opacity.to(like)
        return function.scalar.to(like), torch.cat((density[:, None], function.color.to(like)), dim=1)
