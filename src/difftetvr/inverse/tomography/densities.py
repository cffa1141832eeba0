"""The densities that a tomographic reconstruction optimises."""

from __future__ import annotations

import torch

from difftetvr.fitting.parameters import CarriedAdam
from difftetvr.mesh.changes.change import MeshChange
from difftetvr.mesh.field import Field
from difftetvr.mesh.tetmesh import TetMesh

_START = 0.5  # of the mean density


class Densities:
    """Densities on the vertices of a mesh, in units of the mean one, with their Adam optimiser; never negative.

    Attributes:
        values: (V,) leaf tensor.
        unit: Density per unit of length that 1 stands for.
        is_free: (V,) bool, where the density is and stays 0.
    """

    def __init__(self, mesh: TetMesh, unit: float, betas: tuple[float, float]) -> None:
        """Half the mean density everywhere."""
        self.unit = unit
        self.values = torch.full((mesh.num_vertices,), _START, device=mesh.vertices.device).requires_grad_()
        self.is_free = torch.zeros_like(self.values, dtype=torch.bool)
        self._optimizer = CarriedAdam([[self.values]], betas)

    def field(self) -> Field:
        """The field that the parameters stand for, differentiable in them."""
        return Field(self.values.new_zeros(len(self.values), 0), self.unit * self.values, "vertex")

    def detached(self) -> torch.Tensor:
        """(V,) densities per unit of length."""
        return self.unit * self.values.detach()

    def carry(self, change: MeshChange) -> None:
        """Follows a change of the mesh; new vertices start with interpolated densities."""
        self.is_free = self.is_free[change.parents[:, 0].long()] & ~change.is_new
        self.values = self._optimizer.carry(self.values, change.carry(self.values.detach()), change)

    def keep_free(self, is_free: torch.Tensor) -> None:
        """Makes the density 0 where nothing can be, now and after all further steps.

        Args:
            is_free: (V,) bool.
        """
        self.is_free = is_free
        self._project()

    def set(self, values: torch.Tensor) -> None:
        """Takes other values, (V,) in units; those that cannot be become 0."""
        with torch.no_grad():
            self.values.copy_(values)
        self._project()

    def zero_grad(self) -> None:
        """Forgets the gradients before the views of a step are accumulated."""
        self._optimizer.zero_grad()

    def step(self, rate: float) -> None:
        """One projected Adam step with the accumulated gradients."""
        self._optimizer.step([rate])
        self._project()

    def state(self) -> dict[str, torch.Tensor]:
        """Densities and optimiser state by name."""
        moments = {f"density.{name}": tensor for name, tensor in self._optimizer.state(self.values).items()}
        return {"density": self.values, **moments}

    def restore(self, tensors: dict[str, torch.Tensor]) -> None:
        """The inverse of :meth:`state`."""
        with torch.no_grad():
            for name, tensor in self.state().items():
                tensor.copy_(tensors[name])

    @torch.no_grad()
    def _project(self) -> None:
        self.values.clamp_(min=0.0).masked_fill_(self.is_free, 0.0)
