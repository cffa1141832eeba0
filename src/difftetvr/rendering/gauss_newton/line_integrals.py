"""Gradient and second derivatives of a loss of line integrals by hat functions on vertices, edges and faces."""

from __future__ import annotations

import torch

from difftetvr.errors import DiffTetError
from difftetvr.inputs import require_type
from difftetvr.memory import tried_twice
from difftetvr.mesh import Field, TetMesh
from difftetvr.recording import eager
from difftetvr.rendering.gauss_newton.choice import HatChoice, space_of
from difftetvr.rendering.gauss_newton.models import HatDerivatives, ImageModel, StepDerivatives
from difftetvr.rendering.kernels.hats.absorption import RECORD, IntegralErrors, absorption_records
from difftetvr.rendering.preparation import ViewOptions, prepare_view
from difftetvr.rendering.rays import Rays, RaySource


@eager
@tried_twice
@torch.no_grad()
def model_line_integrals(
    mesh: TetMesh,
    density: torch.Tensor,
    camera: RaySource | Rays,
    errors: tuple[torch.Tensor, torch.Tensor],
    hats: HatChoice,
    deterministic: bool = False,
) -> ImageModel:
    """Predicts what changes of the mesh would do to a loss of its line integrals.

    They are linear in densities, so of a squared error the models say all, but that hats of edges and faces are taken
    in four pieces a crossing. Colours have no part in it: their derivatives are 0.

    Args:
        mesh: Mesh.
        density: (V,) densities of its vertices, on its device.
        camera: Camera of the view, or rays of any shape (...).
        errors: (...) first and second derivatives of the loss by each line integral.
        hats: Edges and steps of faces that are looked at; of a step the density.
        deterministic: Whether sums are the same in every run to the last bit, see :func:`difftetvr.render`.

    Returns:
        The model, in the precision and on the device of the mesh; its error is left at 0.

    Raises:
        MeshError: The densities do not fit the mesh, or are invalid.
        DiffTetError: An argument has a wrong shape, there is no ray, or there are no steps of faces.
        BackendError: No back end runs on the device of the mesh.
    """
    view = prepare_view(mesh, Field(density.new_zeros(len(density), 0), density, "vertex"), camera, ViewOptions())
    for tensor in errors:
        if tuple(tensor.shape) != tuple(view.shape):
            raise DiffTetError(f"A derivative has shape {tuple(tensor.shape)}; this view takes {tuple(view.shape)}.")
    if 0 in view.shape:
        raise DiffTetError(f"The view has the shape {view.shape}, so it says nothing; pass one of a ray at least.")
    require_type(hats, HatChoice, "hats", "pass a HatChoice", DiffTetError)
    if hats.face_steps is None:
        raise DiffTetError("No steps of faces are passed, and line integrals have no models of all of them; pass some.")
    hats.require_fit(mesh)
    backend = view.task.backend
    tracer = view.tracer(view.ends)
    with backend.exclusive(deterministic):
        space = space_of(hats, view, mesh, RECORD)
        density_steps = space.faces.values(hats.face_steps)[:, 3].to(mesh.vertices) * view.unit
        slopes, curvatures, steps = (backend.floats(part.reshape(-1)) for part in (*errors, density_steps))
        records = absorption_records(tracer, IntegralErrors(slopes, curvatures, steps), space, deterministic)
        rows, edges, faces = space.tensors(records)
    return ImageModel(
        HatDerivatives.of_density(rows).with_density_unit(view.unit),
        HatDerivatives.of_density(edges).with_density_unit(view.unit),
        None,
        0.0,
        StepDerivatives(faces[:, 0], faces[:, 1]),
    )
