"""Features of cells, seen through a density that need not be constant in them."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch

from difftetvr.errors import DiffTetError, MeshError, counted, shown
from difftetvr.inputs import as_reals, moved, require_type
from difftetvr.mesh import Field, TetMesh
from difftetvr.mesh.field import MOST_CHANNELS, Location
from difftetvr.rendering.scalar_field import ScalarField


@dataclass(frozen=True, eq=False)
class CellFeatures:
    """What cells show by a medium of their mesh: channels constant in each cell, absorbed as a field is.

    The medium's density decides how much of a cell is seen, linear in it where the field lives on vertices; its own
    colours do not count. Gradients reach the features, the density, and a transfer function's knots.

    Attributes:
        features: (T, C) channels of each cell, 0 to 64 of them, of any sign; float32 or float64, finite where they are
            seen; may require grad.
        medium: The field whose density absorbs.

    Raises:
        MeshError: The features are no numbers of such a shape, or the medium is no field.
    """

    features: torch.Tensor
    medium: Field | ScalarField

    def __post_init__(self) -> None:
        features = as_reals(self.features, "The features", MeshError)
        object.__setattr__(self, "features", features)
        if features.dim() != 2 or features.shape[1] > MOST_CHANNELS:
            raise MeshError(
                f"The features have shape {tuple(features.shape)}; pass (T, C), up to {MOST_CHANNELS} channels for "
                "each cell."
            )
        require_type(
            self.medium, (Field, ScalarField), "The medium", "pass a difftetvr.Field or ScalarField", MeshError
        )

    def validate(self, mesh: TetMesh) -> None:
        """Check that all features are finite at the precision of a mesh, as rendering does where something is not.

        Raises:
            MeshError: One is not; names the first such cell.
        """
        features = self.features.detach().to(mesh.vertices.dtype)
        finite = torch.isfinite(features).all(1)
        if not bool(finite.all()):
            cell = int(torch.nonzero(~finite)[0])
            values = shown(features[cell].tolist())
            raise MeshError(f"The features of cell {cell} are {values}; make every feature finite.")

    def location_on(self, mesh: TetMesh) -> Location:
        """Where on a mesh the medium lives.

        Raises:
            MeshError: The features or the medium do not fit the mesh.
        """
        location = self.medium.location_on(mesh)
        if len(self.features) != mesh.num_cells:
            raise MeshError(
                f"There are features of {counted(len(self.features), 'cell')}, but this mesh has {mesh.num_cells}; "
                "pass one row for each cell."
            )
        return location

    def without_colours(self) -> Field | ScalarField:
        """The medium alone: a field of densities has no channels left."""
        if isinstance(self.medium, ScalarField):
            return self.medium
        return Field(self.medium.color[:, :0], self.medium.density, self.medium.location)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> CellFeatures:
        """The same on another device or in another precision; autograd sees it as a function of this.

        Raises:
            MeshError: This machine has no such device.
        """
        features = moved(self.features, device, dtype, MeshError)
        return dataclasses.replace(self, features=features, medium=self.medium.to(device, dtype))


def medium_of(mesh: TetMesh, field: Field | ScalarField | CellFeatures) -> CellFeatures:
    """What absorbs of a field, without anything to be seen.

    Raises:
        DiffTetError: These are no mesh and no field.
    """
    require_type(mesh, TetMesh, "mesh", "pass a difftetvr.TetMesh", DiffTetError)
    medium = field.medium if isinstance(field, CellFeatures) else field
    require_type(
        medium,
        (Field, ScalarField),
        "field",
        "pass one difftetvr.Field, ScalarField or CellFeatures",
        DiffTetError,
    )
    return CellFeatures(mesh.vertices.new_zeros(mesh.num_cells, 0), medium)
