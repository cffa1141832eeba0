"""Which changes of a mesh are asked about."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from difftetvr.errors import DiffTetError, shown
from difftetvr.mesh import TetMesh
from difftetvr.rendering.kernels.hats.space import Chosen, HatSpace
from difftetvr.rendering.preparation import PreparedView


@dataclass(frozen=True)
class HatChoice:
    """Which hat functions are looked at. The fewer, the less work: half of the edges save a fifth of it.

    Attributes:
        edges: (E,) bool, which of ``mesh.topology.edges``; None: all. Models of the others are 0.
        face_steps: (F, 4) the one step of each face's hat that is looked at, (r, g, b, density), in the order of
            ``mesh.topology.faces``: a third less work than for all steps. Steps of 0 cost nothing. None: all steps.
    """

    edges: torch.Tensor | None = None
    face_steps: torch.Tensor | None = None

    def require_fit(self, mesh: TetMesh) -> None:
        """Checks that these are edges and faces of a mesh.

        Raises:
            DiffTetError: They are not.
        """
        edges, faces = mesh.topology.edges.shape[0], mesh.topology.faces.shape[0]
        mask, steps = self.edges, self.face_steps
        if mask is not None and not (
            isinstance(mask, torch.Tensor) and mask.dtype == torch.bool and mask.shape == (edges,)
        ):
            raise DiffTetError(f"edges is {shown(mask)}; pass a bool tensor of shape {(edges,)}, one for each edge.")
        if steps is not None and not (
            isinstance(steps, torch.Tensor) and steps.is_floating_point() and steps.shape == (faces, 4)
        ):
            raise DiffTetError(f"face_steps is {shown(steps)}; pass floats of shape {(faces, 4)}, one step a face.")
        for name, part in (("edges", mask), ("face_steps", steps)):
            if part is not None and part.device != mesh.vertices.device:
                raise DiffTetError(f"{name} is on '{part.device}', the mesh on '{mesh.vertices.device}'; move one.")

    def from_density_unit(self, unit: float) -> HatChoice:
        """The same for a field's own densities, of steps whose densities are counted in a unit.

        Args:
            unit: How much density 1 stands for.
        """
        if self.face_steps is None:
            return self
        return replace(self, face_steps=torch.cat((self.face_steps[:, :3], unit * self.face_steps[:, 3:]), 1))


def space_of(hats: HatChoice, view: PreparedView, mesh: TetMesh, floats: int) -> HatSpace:
    """The hats of a mesh in a view.

    Args:
        hats: Which ones.
        view: The view.
        mesh: The mesh.
        floats: What is known of a hat.
    """
    topology, steps = mesh.topology, hats.face_steps
    edges = Chosen(hats.edges, topology.edges.shape[0])
    faces = Chosen(None if steps is None else (steps != 0).any(1), topology.faces.shape[0])
    return HatSpace(view.task.backend, mesh, view.upload.order, edges, faces, floats, steps is not None)
