"""Quadratic models of an image's squared error, one for each hat function on vertices, edges and faces."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch

from difftetvr.mesh import TetMesh

_TINY = 1e-30


@dataclass(frozen=True)
class HatDerivatives:
    """Quadratic models of the squared error, one for each of N hat functions with coefficients (r, g, b, density).

    For one hat alone the model is ``error(s) = error(0) + <gradient, s> + <s, H s> / 2`` with the matrix H of
    ``emission`` on the diagonal of colours, ``coupling`` between them and density, and ``absorption`` of density.

    Attributes:
        gradient: (N, 4) derivatives of the error.
        emission: (N,) second derivative by each colour.
        coupling: (N, 3) mixed second derivatives by a colour and density.
        absorption: (N,) second derivative by density.
        weight: (N,) sum over all rays of their responses to the colour: how much of the hat is seen.
    """

    gradient: torch.Tensor
    emission: torch.Tensor
    coupling: torch.Tensor
    absorption: torch.Tensor
    weight: torch.Tensor

    @staticmethod
    def zeros(like: torch.Tensor, count: int) -> HatDerivatives:
        """Models of no error.

        Args:
            like: Of the device and type wanted.
            count: Number N of the hats.
        """
        return HatDerivatives(*(like.new_zeros(count, *shape) for shape in ((4,), (), (3,), (), ())))

    @staticmethod
    def of_density(records: torch.Tensor, curvature: float = 1.0) -> HatDerivatives:
        """Models that know of nothing but density.

        Args:
            records: (N, 2) first and second derivatives by it.
            curvature: Factor of the second ones.
        """
        zero = records.new_zeros(())
        gradient = torch.nn.functional.pad(records[:, :1], (3, 0))
        count = len(records)
        return HatDerivatives(
            gradient, zero.expand(count), zero.expand(count, 3), curvature * records[:, 1], zero.expand(count)
        )

    def __add__(self, other: HatDerivatives) -> HatDerivatives:
        """Models of the sum of two errors."""
        return HatDerivatives(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))

    def __getitem__(self, rows: torch.Tensor) -> HatDerivatives:
        """The models of some of the hats, (M,) indices."""
        return HatDerivatives(*(getattr(self, f.name)[rows] for f in fields(self)))

    def scaled(self, factor: float) -> HatDerivatives:
        """Models of a multiple of the error."""
        return HatDerivatives(*(getattr(self, f.name) * (1.0 if f.name == "weight" else factor) for f in fields(self)))

    def with_density_unit(self, unit: float) -> HatDerivatives:
        """The same models with densities counted in another unit.

        Args:
            unit: How much density a coefficient of 1 stands for from now on.
        """
        if unit == 1.0:
            return self
        gradient = torch.cat((self.gradient[:, :3], unit * self.gradient[:, 3:]), 1)
        return HatDerivatives(gradient, self.emission, unit * self.coupling, unit * unit * self.absorption, self.weight)

    def decrease(self, step: torch.Tensor) -> torch.Tensor:
        """How much the error falls by a step of each hat alone, as predicted.

        Args:
            step: (N, 4).

        Returns:
            (N,), negative where the error grows.
        """
        return -(self.gradient * step).sum(1) - 0.5 * self.curvature(step)

    def curvature(self, step: torch.Tensor) -> torch.Tensor:
        """(N,) second derivatives of the error along steps (N, 4): <s, H s>."""
        color, density = step[:, :3], step[:, 3]
        mixed = density * (self.coupling * color).sum(1)
        return self.emission * color.square().sum(1) + self.absorption * density.square() + 2.0 * mixed

    def best_step(self, lower: torch.Tensor, upper: torch.Tensor, damping: float = 0.0) -> torch.Tensor:
        """A step of each hat alone between bounds: where none of them binds, the one that minimises its model.

        The density is the one that is best with the best colours, within its bounds; the colours are the best ones
        with that density, within theirs.

        Args:
            lower: (N, 4) least step.
            upper: (N, 4) greatest step.
            damping: Added to second derivatives, in units of their means over all hats: so hats that hardly any ray
                sees do not follow noise.

        Returns:
            (N, 4); 0 where nothing is seen.
        """
        emission = self.emission + damping * self.emission.mean() + _TINY
        absorption = self.absorption + damping * self.absorption.mean() + _TINY
        color_gradient, density_gradient = self.gradient[:, :3], self.gradient[:, 3]
        eliminated = (self.coupling * color_gradient).sum(1) / emission
        # By Cauchy and Schwarz the difference is not negative; where colour explains all, rounding may make it so.
        left = torch.maximum(absorption - self.coupling.square().sum(1) / emission, 1e-4 * absorption)
        density = ((eliminated - density_gradient) / left).clamp(lower[:, 3], upper[:, 3])
        color = -(color_gradient + self.coupling * density[:, None]) / emission[:, None]
        return torch.cat((color.clamp(lower[:, :3], upper[:, :3]), density[:, None]), 1)


@dataclass(frozen=True)
class StepDerivatives:
    """Quadratic models of the squared error along one step of each of N hats: ``error(0) + slope + curvature / 2``.

    Attributes:
        slope: (N,) derivative of the error by the length of the step.
        curvature: (N,) second derivative.
    """

    slope: torch.Tensor
    curvature: torch.Tensor

    def __add__(self, other: StepDerivatives) -> StepDerivatives:
        """Models of the sum of two errors."""
        return StepDerivatives(self.slope + other.slope, self.curvature + other.curvature)

    def scaled(self, factor: float) -> StepDerivatives:
        """Models of a multiple of the error."""
        return StepDerivatives(factor * self.slope, factor * self.curvature)

    def decrease(self) -> torch.Tensor:
        """(N,) how much the error falls by each step alone, as predicted; negative where it grows."""
        return -self.slope - 0.5 * self.curvature


@dataclass(frozen=True)
class ImageModel:
    """What a view's squared error says about every vertex, edge and face of a mesh.

    Attributes:
        vertices: V hats, of ``mesh.vertices``: changes of their values.
        edges: E hats, of ``mesh.topology.edges``: surplus of a new vertex in the middle over its linear interpolation.
        faces: F hats, of ``mesh.topology.faces``; nothing is known of faces on the boundary. None where one step of
            each was asked for.
        error: Mean over pixels and channels of the squared difference from the truth.
        face_steps: F steps of these hats; None where none were asked for.
    """

    vertices: HatDerivatives
    edges: HatDerivatives
    faces: HatDerivatives | None
    error: float
    face_steps: StepDerivatives | None = None

    @staticmethod
    def zero(mesh: TetMesh, has_steps: bool) -> ImageModel:
        """The model of no image at all, which is 0.

        Args:
            mesh: The mesh.
            has_steps: Whether one step of each face is asked for.
        """
        like, topology = mesh.vertices.detach(), mesh.topology
        edges, faces = topology.edges.shape[0], topology.faces.shape[0]
        return ImageModel(
            HatDerivatives.zeros(like, mesh.num_vertices),
            HatDerivatives.zeros(like, edges),
            None if has_steps else HatDerivatives.zeros(like, faces),
            0.0,
            StepDerivatives(like.new_zeros(faces), like.new_zeros(faces)) if has_steps else None,
        )

    def __add__(self, other: ImageModel) -> ImageModel:
        """The model of two views' summed errors."""
        return ImageModel(
            self.vertices + other.vertices,
            self.edges + other.edges,
            None if self.faces is None or other.faces is None else self.faces + other.faces,
            self.error + other.error,
            None if self.face_steps is None or other.face_steps is None else self.face_steps + other.face_steps,
        )

    def with_density_unit(self, unit: float) -> ImageModel:
        """The same model with densities counted in another unit, see :meth:`HatDerivatives.with_density_unit`.

        Steps of faces stay the steps that they are.
        """
        vertices, edges = (part.with_density_unit(unit) for part in (self.vertices, self.edges))
        faces = None if self.faces is None else self.faces.with_density_unit(unit)
        return replace(self, vertices=vertices, edges=edges, faces=faces)

    def scaled(self, factor: float) -> ImageModel:
        """The model of a multiple of the error."""
        return ImageModel(
            self.vertices.scaled(factor),
            self.edges.scaled(factor),
            None if self.faces is None else self.faces.scaled(factor),
            factor * self.error,
            None if self.face_steps is None else self.face_steps.scaled(factor),
        )
