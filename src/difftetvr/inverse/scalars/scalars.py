"""The scalars that a reconstruction optimises."""

from __future__ import annotations

import torch

from difftetvr.fitting.parameters import CarriedAdam
from difftetvr.mesh.changes.change import MeshChange


class Scalars:
    """Scalars on the vertices of a mesh with their Adam optimiser; in [0, 1].

    Attributes:
        values: (V,) leaf tensor.
    """

    def __init__(self, values: torch.Tensor, betas: tuple[float, float]) -> None:
        """Starts at rest.

        Args:
            values: (V,) those to begin with.
            betas: Decay of first and second moments.
        """
        self.values = values.detach().clone().requires_grad_()
        self._optimizer = CarriedAdam([[self.values]], betas)

    def carry(self, change: MeshChange) -> None:
        """Follows a change of the mesh; new vertices start with interpolated scalars."""
        self.values = self._optimizer.carry(self.values, change.carry(self.values.detach()), change)

    def add(self, surplus: torch.Tensor) -> None:
        """Changes the scalars by (V,) others."""
        with torch.no_grad():
            self.values.add_(surplus.to(self.values)).clamp_(0.0, 1.0)

    def zero_grad(self) -> None:
        """Forgets the gradients before the views of a step are accumulated."""
        self._optimizer.zero_grad()

    def step(self, rate: float) -> None:
        """One projected Adam step with the accumulated gradients."""
        self._optimizer.step([rate])
        with torch.no_grad():
            self.values.clamp_(0.0, 1.0)

    def state(self) -> dict[str, torch.Tensor]:
        """Scalars and optimiser state by name."""
        moments = {f"scalar.{name}": tensor for name, tensor in self._optimizer.state(self.values).items()}
        return {"scalar": self.values, **moments}

    def restore(self, tensors: dict[str, torch.Tensor]) -> None:
        """The inverse of :meth:`state`."""
        with torch.no_grad():
            for name, tensor in self.state().items():
                tensor.copy_(tensors[name])
