"""Gradient and second derivatives of a loss of line integrals by hat functions on vertices, edges and faces."""

from __future__ import annotations

import torch

from difftetvr.errors import DiffTetError
from difftetvr.memory import tried_twice
from difftetvr.mesh import Field, TetMesh
from difftetvr.recording import eager
from difftetvr.rendering.gauss_newton.models import HatDerivatives, ImageModel, StepDerivatives
from difftetvr.rendering.kernels.hats.absorption import RECORD, IntegralErrors, absorption_records
from difftetvr.rendering.kernels.hats.kernel import STEP_RECORD, HatSpace
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
    face_steps: torch.Tensor,
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
        face_steps: (F,) the one step of density of each face's hat that is looked at, in the order of
            ``mesh.topology.faces``. Steps of 0 cost nothing.
        deterministic: Whether sums are the same in every run to the last bit, see :func:`difftetvr.render`.

    Returns:
        The model, in the precision and on the device of the mesh; its error is left at 0.

    Raises:
        MeshError: The densities do not fit the mesh, or are invalid.
        DiffTetError: An argument has a wrong shape, or there is no ray.
        BackendError: No back end runs on the device of the mesh.
    """
    topology = mesh.topology
    view = prepare_view(mesh, Field(density.new_zeros(len(density), 0), density, "vertex"), camera, ViewOptions())
    wanted = [(view.shape, errors[0]), (view.shape, errors[1]), ((topology.faces.shape[0],), face_steps)]
    for shape, tensor in wanted:
        if tuple(tensor.shape) != tuple(shape):
            raise DiffTetError(f"A derivative or step has shape {tuple(tensor.shape)}; this view takes {tuple(shape)}.")
    if 0 in view.shape:
        raise DiffTetError(f"The view has the shape {view.shape}, so it says nothing; pass one of a ray at least.")
    backend = view.task.backend
    tracer = view.tracer(view.ends)
    with backend.exclusive(deterministic):
        slopes, curvatures, steps = (
            backend.floats(part.reshape(-1)) for part in (*errors, face_steps.to(mesh.vertices) * view.unit)
        )
        space = HatSpace.of(mesh, view.upload.order, [RECORD, RECORD, STEP_RECORD])
        records = absorption_records(tracer, IntegralErrors(slopes, curvatures, steps), space, deterministic)
        rows, edges, faces = (
            backend.tensor(part, -1, 2)[:count]
            for part, count in (
                (records.vertices, mesh.num_vertices),
                (records.edges, topology.edges.shape[0]),
                (records.faces, topology.faces.shape[0]),
            )
        )
    return ImageModel(
        HatDerivatives.of_density(view.upload.order.in_order_of_mesh(rows)).with_density_unit(view.unit),
        HatDerivatives.of_density(edges).with_density_unit(view.unit),
        None,
        0.0,
        StepDerivatives(faces[:, 0], faces[:, 1]),
    )
