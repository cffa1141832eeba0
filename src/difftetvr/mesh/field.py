"""Colour and density on a tetrahedral mesh."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch

from difftetvr.errors import MeshError, counted, shown
from difftetvr.inputs import as_reals, handed_over, moved, require_type
from difftetvr.mesh.harmonics import COUNTS, seen_colors
from difftetvr.mesh.tetmesh import TetMesh

Location = Literal["vertex", "cell"]

MOST_CHANNELS = 64


@dataclass(frozen=True, eq=False)
class Field:
    """What a mesh emits and absorbs: linear between its vertices, or constant in each cell.

    Attributes:
        color: (V, C) per vertex or (T, C) per cell; emitted linear RGB, or any other 0 to 64 channels, which may be
            negative; float32 or float64, may require grad.
        density: (V,) or (T,) extinction per unit length, >= 0, of the same length; may require grad.
        location: "vertex" or "cell"; None lets the lengths decide, vertices first where both fit.
        harmonics: (V, B, 3) or (T, B, 3) coefficients of the spherical harmonics that are added to ``color``, with B 3,
            8 or 15 for bands up to 1, 2 or 3 (see `difftetvr.mesh.harmonics`); None for colours that are the same
            from all sides. Seen from the camera, a colour never falls below 0. May require grad.

    Raises:
        MeshError: The shapes do not belong together, the values are no real numbers, or the location is unknown.
    """

    color: torch.Tensor
    density: torch.Tensor
    location: Location | None = None
    harmonics: torch.Tensor | None = None

    def __post_init__(self) -> None:
        color = as_reals(self.color, "The field's color", MeshError)
        density = as_reals(self.density, "The field's density", MeshError)
        if color.ndim != 2 or color.shape[1] > MOST_CHANNELS:
            raise MeshError(
                f"The field's color has shape {tuple(color.shape)}; pass linear RGB of shape (N, 3), or (N, C) with up "
                f"to {MOST_CHANNELS} channels."
            )
        if density.shape != color.shape[:1]:
            raise MeshError(
                f"The field's density has shape {tuple(density.shape)} and its color {tuple(color.shape)}; "
                f"pass one density for each color, shape ({color.shape[0]},)."
            )
        require_location(self.location, "The field's location")
        if self.harmonics is not None:
            harmonics = as_reals(self.harmonics, "The field's harmonics", MeshError)
            counts = {(len(color), count, 3) for count in COUNTS[1:]}
            if tuple(harmonics.shape) not in counts or color.shape[1] != 3:
                raise MeshError(
                    f"The field's harmonics have shape {tuple(harmonics.shape)} and its color {tuple(color.shape)}; "
                    f"pass ({len(color)}, B, 3) with B one of {', '.join(str(count) for count in COUNTS[1:])}, and "
                    "three colours."
                )
            object.__setattr__(self, "harmonics", harmonics)
        object.__setattr__(self, "color", color)
        object.__setattr__(self, "density", density)

    def __len__(self) -> int:
        """Number of vertices or cells the field has values for."""
        return self.color.shape[0]

    def location_on(self, mesh: TetMesh) -> Location:
        """Where on `mesh` the values live.

        Args:
            mesh: The mesh the field belongs to.

        Returns:
            "vertex" or "cell".

        Raises:
            MeshError: The field's length is not that of the location.
        """
        return location_of(len(self), self.location, mesh, f"The field has {counted(len(self), 'value')}")

    def arrays(self) -> dict[str, torch.Tensor]:
        """What files keep of it, by name: (N, 3) ``color``, (N,) ``density``, (N, 3 B) ``harmonics`` if it has any."""
        arrays = {"color": self.color, "density": self.density}
        if self.harmonics is not None:
            arrays["harmonics"] = self.harmonics.flatten(1)
        return arrays

    def validate(self, mesh: TetMesh) -> None:
        """Check that the field belongs to the mesh and holds values that can be rendered.

        Args:
            mesh: The mesh the field belongs to.

        Raises:
            MeshError: The length fits neither vertices nor cells, or a color or density is not finite, or a density is
                negative; names the first such vertex or cell.
        """
        location = self.location_on(mesh)
        color, density = self.color.detach(), self.density.detach()
        # Sums and minima carry NaN and infinity along: two fast passes where all is well, the culprit only if not.
        directional = color.new_zeros(()) if self.harmonics is None else self.harmonics.detach().sum().to(color)
        if bool(torch.isfinite(color.sum() + density.sum() + directional) & (density.amin() >= 0)):
            return
        if self.harmonics is not None:
            harmonics = self.harmonics.detach().flatten(1)
            _refuse_first(~torch.isfinite(harmonics).all(1), harmonics, f"harmonics of {location}", "make them finite")
        _refuse_first(~torch.isfinite(color).all(1), color, f"color of {location}", "make every color finite")
        _refuse_first(~torch.isfinite(density), density, f"density of {location}", "make every density finite")
        _refuse_first(density < 0, density, f"density of {location}", "densities must not be negative")

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Field:
        """The same field on another device or in another precision.

        Args:
            device: Target device, or None to stay.
            dtype: torch.float32 or torch.float64, or None to stay.

        Returns:
            A field that autograd sees as a function of this one.

        Raises:
            MeshError: This machine has no such device.
        """
        color, density = (moved(tensor, device, dtype, MeshError) for tensor in (self.color, self.density))
        harmonics = None if self.harmonics is None else moved(self.harmonics, device, dtype, MeshError)
        return Field(color, density, self.location, harmonics)

    def seen_from(self, mesh: TetMesh, eye: torch.Tensor) -> Field:
        """The colours that a camera sees, of each vertex or cell along the line from the camera to it.

        Args:
            mesh: The mesh the field belongs to.
            eye: (3,) position of the camera, or (N, 3) one for each value; differentiable, as are the mesh's vertices.

        Returns:
            A field without harmonics; this one if it has none.
        """
        if self.harmonics is None:
            return self
        places = mesh.vertices
        if self.location_on(mesh) == "cell":
            places = places[mesh.tets.long()].mean(1)
        return self._seen_along(places - handed_over(eye, places))

    def seen_along(self, direction: torch.Tensor) -> Field:
        """The colours that parallel rays see, such as those of an orthographic camera.

        Args:
            direction: (3,) where the rays go, of any length but 0, or (N, 3) likewise; differentiable.

        Returns:
            A field without harmonics; this one if it has none.
        """
        if self.harmonics is None:
            return self
        return self._seen_along(direction.reshape(-1, 3).to(self.color.device))

    def _seen_along(self, vectors: torch.Tensor) -> Field:
        """The colours along (N, 3) vectors, or (1, 3) for all."""
        assert self.harmonics is not None
        return Field(seen_colors(self.color, self.harmonics, vectors), self.density, self.location)


def require_location(location: Any, name: str) -> None:
    """Refuse what is no `Location` and not None.

    Raises:
        MeshError: Says what it is, and that it was passed as ``name``.
    """
    if not (location is None or (isinstance(location, str) and location in ("vertex", "cell"))):
        raise MeshError(f'{name} is {shown(location)}; pass "vertex", "cell" or None.')


def location_of(count: int, location: Location | None, mesh: TetMesh, subject: str) -> Location:
    """Where on a mesh a number of values live.

    Args:
        count: Their number.
        location: Where they are said to live; None lets the number decide, vertices first where both fit.
        mesh: The mesh.
        subject: Beginning of the message where they fit neither: "The field has 3 values".

    Raises:
        MeshError: Their number is not that of the location.
    """
    require_type(mesh, TetMesh, "The mesh", "pass a difftetvr.TetMesh", MeshError)
    counts: dict[Location, int] = {"vertex": mesh.num_vertices, "cell": mesh.num_cells}
    candidates: tuple[Location, ...] = ("vertex", "cell") if location is None else (location,)
    for candidate in candidates:
        if count == counts[candidate]:
            return candidate
    wanted = " or ".join(f"{counts[candidate]} for one per {candidate}" for candidate in candidates)
    raise MeshError(f"{subject}, but this mesh needs {wanted}.")


def _refuse_first(bad: torch.Tensor, values: torch.Tensor, what: str, advice: str) -> None:
    if bad.any():
        index = int(torch.nonzero(bad)[0, 0])
        raise MeshError(f"The {what} {index} is {values[index].tolist()}; {advice}.")
