"""The quantities that a reconstruction optimises."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch.optim.adam import adam

from difftetvr.fitting.config import FitConfig
from difftetvr.mesh.changes.change import MeshChange
from difftetvr.mesh.field import Field
from difftetvr.mesh.harmonics import COUNTS
from difftetvr.mesh.tetmesh import TetMesh

_STEP, _FIRST, _SECOND = "step", "exp_avg", "exp_avg_sq"  # Adam's names of its state
# Gradients of a mean over pixels shrink as cells and pixels do; Adam's usual 1e-8 would drown those of fine meshes.
_EPSILON = 1e-15


class CarriedAdam:
    """Adam for values on the vertices or cells of a mesh, whose moments follow changes of the mesh.

    PyTorch's function, not its class: that imports the compiler, which takes longer than ten steps of a fit.
    """

    def __init__(self, groups: Sequence[Sequence[torch.Tensor]], betas: tuple[float, float]) -> None:
        """Starts at rest.

        Args:
            groups: Leaf tensors, (N, ...), those that share a learning rate together.
            betas: Decay of first and second moments.
        """
        self._groups = [list(group) for group in groups if group]
        self._betas = betas
        self._states: dict[torch.Tensor, dict[str, torch.Tensor]] = {}
        for parameter in (parameter for group in self._groups for parameter in group):
            zeros = torch.zeros_like(parameter, requires_grad=False)
            count = torch.zeros((), device=parameter.device)
            self._states[parameter] = {_STEP: count, _FIRST: zeros, _SECOND: zeros.clone()}

    def state(self, parameter: torch.Tensor) -> dict[str, torch.Tensor]:
        """Moments of a parameter, and its count of steps, by name."""
        return self._states[parameter]

    def carry(self, parameter: torch.Tensor, value: torch.Tensor, change: MeshChange) -> torch.Tensor:
        """A parameter's successor on the mesh after a change, at rest where vertices are new.

        The first moment of new ones is 0, the second the mean of the ends of the edge they lie on. The count of steps
        goes on for all.

        Args:
            parameter: The parameter, on the mesh before it.
            value: (N', ...) its value after it.
            change: What was done to the mesh.
        """
        state = self._states.pop(parameter)
        first = change.carry(state[_FIRST])
        is_new = change.is_new.view(-1, *[1] * (first.ndim - 1))
        state[_FIRST] = torch.where(is_new, 0.0, first)
        state[_SECOND] = change.carry(state[_SECOND])
        carried = value.requires_grad_()
        self._states[carried] = state
        self._groups = [[carried if one is parameter else one for one in group] for group in self._groups]
        return carried

    def zero_grad(self) -> None:
        """Forgets the gradients."""
        for parameter in self._states:
            parameter.grad = None

    @torch.no_grad()
    def step(self, rates: Sequence[float]) -> None:
        """One step with the accumulated gradients, and a rate for each group."""
        for group, rate in zip(self._groups, rates):
            trained = [parameter for parameter in group if parameter.grad is not None]
            if not trained:
                continue
            states = [self._states[parameter] for parameter in trained]
            adam(
                trained,
                [parameter.grad for parameter in trained if parameter.grad is not None],
                [state[_FIRST] for state in states],
                [state[_SECOND] for state in states],
                [],
                [state[_STEP] for state in states],
                fused=True,
                amsgrad=False,
                beta1=self._betas[0],
                beta2=self._betas[1],
                lr=rate,
                weight_decay=0.0,
                eps=_EPSILON,
                maximize=False,
            )


class FieldParameters:
    """Colours and densities on a mesh, directional colours too if wanted, with their Adam optimiser.

    Density is stored in units of the capture's typical density, so that one learning rate fits scenes of any size.
    After each step the parameters are projected to the valid ranges, colours to [0, 1] and densities to [0, inf), or to
    0 where nothing can be: unlike under an exponential or softplus, empty space reaches a density of exactly 0.

    Attributes:
        color: (N, 3) leaf tensor, linear RGB; N vertices or cells.
        density: (N,) leaf tensor in units of ``density_unit``.
        harmonics: (N, B, 3) leaf tensor, coefficients of the directional part of the colours; None without it.
        density_unit: (N,) densities per unit length that parameters of 1 stand for.
        is_free: (N,) bool, where nothing can be: densities stay 0.
        location: ``"vertex"`` or ``"cell"``, what the N entries belong to.
    """

    def __init__(
        self, mesh: TetMesh, config: FitConfig, density_unit: torch.Tensor, initial: Field | None = None
    ) -> None:
        """Values before the first step.

        Args:
            mesh: What they are values on.
            config: Options, chosen for the capture.
            density_unit: (N,) densities per unit length that parameters of 1 stand for.
            initial: Field to begin with, at the location of the options; default: the options' initial values.
        """
        count = mesh.num_vertices if config.location == "vertex" else mesh.num_cells
        device = mesh.vertices.device
        self.location = config.location
        self.density_unit = density_unit.to(device, torch.float32)
        self.is_free = torch.zeros(count, dtype=torch.bool, device=device)
        color = torch.full((count, 3), config.initial_color, device=device)
        density = torch.full((count,), config.initial_density, device=device)
        if initial is not None:
            color.copy_(initial.color.detach())
            density.copy_(initial.density.detach().double() / self.density_unit)
        bands = COUNTS[config.harmonics or 0]
        harmonics = torch.zeros(count, bands, 3, device=device) if bands else None
        if harmonics is not None and initial is not None and initial.harmonics is not None:
            shared = min(bands, initial.harmonics.shape[1])
            harmonics[:, :shared] = initial.harmonics.detach()[:, :shared]
        self.color, self.density = color.requires_grad_(), density.requires_grad_()
        self.harmonics = None if harmonics is None else harmonics.requires_grad_()
        self._shares = [1.0, config.density_rate or 1.0, config.harmonics_rate]
        self._optimizer = CarriedAdam(self._groups(), config.betas)

    def field(self, bands: int) -> Field:
        """The field that the parameters stand for, differentiable in them.

        Args:
            bands: Bands of the harmonics that take part.
        """
        harmonics = self.harmonics[:, : COUNTS[bands]] if self.harmonics is not None and bands else None
        return Field(self.color, self.density_unit * self.density, self.location, harmonics)

    def leaves(self) -> dict[str, torch.Tensor]:
        """All that is learned, by name."""
        directional = {} if self.harmonics is None else {"harmonics": self.harmonics}
        return {"color": self.color, "density": self.density, **directional}

    def trained(self, bands: int) -> list[torch.Tensor]:
        """What the gradients of :meth:`field` gather in.

        Args:
            bands: Bands of the harmonics that take part.
        """
        return [leaf for name, leaf in self.leaves().items() if bands or name != "harmonics"]

    def detached_field(self) -> Field:
        """A copy of the field as it is now, without gradients."""
        color, density = self.color.detach().clone(), self.density_unit * self.density.detach()
        harmonics = None if self.harmonics is None else self.harmonics.detach().clone()
        return Field(color, density, self.location, harmonics)

    def values(self, unit: float) -> torch.Tensor:
        """(N, 4) copy of the field: linear RGB, and density in a unit that is the same everywhere.

        Args:
            unit: Density per unit length that a value of 1 stands for.
        """
        density = self.density.detach() * (self.density_unit / unit)
        return torch.cat((self.color.detach(), density[:, None]), 1)

    def carry(self, change: MeshChange) -> None:
        """Follows a change of the mesh, for parameters on vertices.

        Kept vertices keep their values and moments. New ones start with interpolated values at rest. None of the new
        ones is known to be free.

        Args:
            change: What was done to the mesh.
        """
        unit = change.carry(self.density_unit)
        # Where units differ, densities are what is linear along edges.
        density = change.carry(self.density_unit * self.density.detach()) / unit
        self.density_unit = unit
        self.is_free = self.is_free[change.parents[:, 0].long()] & ~change.is_new
        for name, parameter in self.leaves().items():
            value = density if name == "density" else change.carry(parameter.detach())
            setattr(self, name, self._optimizer.carry(parameter, value, change))

    def keep_free(self, is_free: torch.Tensor) -> None:
        """Makes the field empty where nothing can be, now and after all further steps.

        Args:
            is_free: (N,) bool.
        """
        self.is_free = is_free
        self._project()

    def add(self, surplus: torch.Tensor, unit: float) -> None:
        """Changes the field, and projects it to the valid ranges.

        Args:
            surplus: (N, 4), in the order of :meth:`values`.
            unit: Density per unit length that a value of 1 stands for.
        """
        with torch.no_grad():
            self.color += surplus[:, :3]
            self.density += surplus[:, 3] * (unit / self.density_unit)
        self._project()

    def zero_grad(self) -> None:
        """Forgets the gradients before the views of a step are accumulated."""
        self._optimizer.zero_grad()

    def step(self, rate: float, haze_penalty: float) -> None:
        """One projected Adam step with the accumulated gradients.

        Args:
            rate: Learning rate.
            haze_penalty: This many mean absolute density gradients are added to every density gradient. Where images
                say something they drown it; fog that no image can tell from the background decays.
        """
        if haze_penalty and self.density.grad is not None:
            self.density.grad += haze_penalty * self.density.grad.abs().mean()
        self._optimizer.step([share * rate for share in self._shares])
        self._project()

    def state(self) -> dict[str, torch.Tensor]:
        """Parameters and optimiser state by name: all that the next step depends on."""
        leaves = self.leaves()
        tensors = {**leaves, "density_unit": self.density_unit, "is_free": self.is_free}
        for name, parameter in leaves.items():
            for key, value in self._optimizer.state(parameter).items():
                tensors[f"{name}.{key}"] = value
        return tensors

    def restore(self, tensors: dict[str, torch.Tensor]) -> None:
        """The inverse of :meth:`state`.

        Args:
            tensors: Of the names, shapes and types of :meth:`state`; others are ignored.
        """
        with torch.no_grad():
            for name, tensor in self.state().items():
                tensor.copy_(tensors[name])

    def _project(self) -> None:
        with torch.no_grad():
            self.color.clamp_(0.0, 1.0)
            self.density.clamp_(min=0.0).masked_fill_(self.is_free, 0.0)

    def _groups(self) -> list[list[torch.Tensor]]:
        """Parameters that share a learning rate."""
        return [[self.color], [self.density], [] if self.harmonics is None else [self.harmonics]]
