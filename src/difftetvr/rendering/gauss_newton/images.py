"""Gradient and Gauss-Newton matrix of an image's squared error by hat functions on vertices, edges and faces."""

from __future__ import annotations

from typing import Any

import torch

from difftetvr.errors import DiffTetError, MeshError, shown
from difftetvr.inputs import as_reals, require_type
from difftetvr.memory import tried_twice
from difftetvr.mesh import Field, TetMesh
from difftetvr.recording import eager
from difftetvr.rendering.api import as_background
from difftetvr.rendering.gauss_newton.choice import HatChoice, space_of
from difftetvr.rendering.gauss_newton.models import HatDerivatives, ImageModel, StepDerivatives
from difftetvr.rendering.kernels.composition import Composition
from difftetvr.rendering.kernels.forward import render_forward
from difftetvr.rendering.kernels.hats.light import RECORD, HatImage, hat_records
from difftetvr.rendering.kernels.hats.scalars import RECORD as SCALAR_RECORD
from difftetvr.rendering.kernels.hats.scalars import scalar_hat_records
from difftetvr.rendering.preparation import PreparedView, ViewOptions, prepare_view
from difftetvr.rendering.rays import Rays, RaySource
from difftetvr.rendering.scalar_field import ScalarField
from difftetvr.rendering.traversal.crossing import Tracer


@eager
@tried_twice
@torch.no_grad()
def model_image(
    mesh: TetMesh,
    field: Field | ScalarField,
    camera: RaySource | Rays,
    truth: torch.Tensor,
    background: torch.Tensor | tuple[float, float, float] | None = None,
    transmittance_threshold: float = 1e-4,
    deterministic: bool = False,
    valid: torch.Tensor | None = None,
    hats: HatChoice | None = None,
) -> ImageModel:
    """Renders a view, and predicts what changes of the mesh would do to its squared error.

    The responses of pixels to hat functions are integrated with four pieces a crossing (article Algorithm 1, with the
    rest of the ray exact), so they are approximate: by a per cent or so where cells are not optically thick.

    Args:
        mesh: Mesh.
        field: Its colours and densities, on vertices; or scalars there, seen through a transfer function. Hats of these
            are of the scalar in units of its range, and have the place of density in the models; colours have no part.
        camera: Camera of the view, or rays that are an image, (H, W).
        truth: (H, W, 3) what the image should be, on the mesh's device.
        background: (3,) linear RGB behind the volume; black if None.
        transmittance_threshold: Rays stop once their transmittance is at or below this value.
        deterministic: Whether sums are the same in every run to the last bit, see :func:`difftetvr.render`.
        valid: (H, W) bool, pixels that have an error; None: all. The curvature counts all of them.
        hats: Edges and steps of faces that are looked at; None: all.

    Returns:
        The model, in the precision and on the device of the mesh.

    Raises:
        MeshError: The field does not fit the mesh, lives on cells, or holds invalid values.
        DiffTetError: The truth has another size than the camera's image, which has no pixels, or an argument is out of
            range.
        BackendError: No back end runs on the device of the mesh.
    """
    options = ViewOptions(transmittance_threshold=transmittance_threshold, deterministic=deterministic)
    view = _prepared(mesh, field, camera, options)
    truth = as_reals(truth, "The true image", DiffTetError)
    hats = HatChoice() if hats is None else hats
    require_type(hats, HatChoice, "hats", "pass a HatChoice", DiffTetError)
    _require_shapes(view, mesh, truth, valid, hats)
    behind = as_background(background, mesh.vertices)
    backend = view.task.backend
    tracer = view.tracer(view.ends)
    with backend.exclusive(deterministic):
        how = Composition(None if behind is None else backend.floats(behind), None, view.unit)
        rendered = render_forward(tracer, how)
        image = backend.tensor(rendered.image.color, *truth.shape)
        residual = image - truth.to(image)
        if valid is not None:
            residual = residual * valid.to(residual.device)[..., None]
        curvature = 2.0 / residual.numel()
        models = (_LightModels if isinstance(field, Field) else _ScalarModels)(view, hats)
        vertices, edges, faces = models.records(tracer, mesh, (image, curvature * residual), deterministic)
    has_steps = hats.face_steps is not None
    return ImageModel(
        models.of(vertices, curvature),
        models.of(edges, curvature),
        None if has_steps else models.of(faces, curvature),
        float(residual.square().mean()),
        StepDerivatives(faces[:, 0], curvature * faces[:, 1]) if has_steps else None,
    )


class _LightModels:
    """Hats of colours and densities: what kernels are asked, and what their records say."""

    floats = RECORD
    gather: Any = staticmethod(hat_records)

    def __init__(self, view: PreparedView, hats: HatChoice) -> None:
        self.view, self.hats = view, hats

    def records(
        self, tracer: Tracer, mesh: TetMesh, image: tuple[torch.Tensor, torch.Tensor], in_order: bool
    ) -> list[torch.Tensor]:
        """Records of vertices, edges and faces in the order of the mesh; of faces those of steps, if there are any.

        Args:
            tracer: The view.
            mesh: The mesh.
            image: (H, W, 3) radiance, and the derivative of the loss by it.
            in_order: Whether sums have a certain order.
        """
        backend, face_steps = self.view.task.backend, self.hats.face_steps
        space = space_of(self.hats, self.view, mesh, self.floats)
        steps = None if face_steps is None else backend.floats(self.steps_of(space.faces.values(face_steps)))
        color, gradient = (backend.floats(part) for part in image)
        return space.tensors(self.gather(tracer, HatImage(color, gradient, steps), space, in_order))

    def steps_of(self, face_steps: torch.Tensor) -> torch.Tensor:
        """Steps of faces as kernels read them, from (M, 4)."""
        return torch.cat((face_steps[:, :3], face_steps[:, 3:] * self.view.unit), 1)

    def of(self, records: torch.Tensor, curvature: float) -> HatDerivatives:
        """Quadratic models from records.

        Args:
            records: (N, width).
            curvature: Second derivative of the loss by a radiance.
        """
        seconds = curvature * records[:, 4:9]
        found = HatDerivatives(records[:, :4], seconds[:, 0], seconds[:, 1:4], seconds[:, 4], records[:, 9])
        return found.with_density_unit(self.view.unit)


class _ScalarModels(_LightModels):
    """Hats of scalars, likewise."""

    floats = SCALAR_RECORD
    gather = staticmethod(scalar_hat_records)

    def steps_of(self, face_steps: torch.Tensor) -> torch.Tensor:
        return face_steps[:, 3].contiguous()

    def of(self, records: torch.Tensor, curvature: float) -> HatDerivatives:
        return HatDerivatives.of_density(records, curvature)


def _prepared(
    mesh: TetMesh, field: Field | ScalarField, camera: RaySource | Rays, options: ViewOptions
) -> PreparedView:
    """The view, which must be of values on vertices."""
    require_type(field, (Field, ScalarField), "field", "pass a difftetvr.Field or a ScalarField", DiffTetError)
    view = prepare_view(mesh, field, camera, options)
    on_vertices = (
        field.location_on(mesh) == "vertex" if isinstance(field, ScalarField) else view.task.content == "vertex"
    )
    if not on_vertices:
        raise MeshError("The field lives on cells; hat functions need colours and densities, or scalars, on vertices.")
    return view


def _require_shapes(
    view: PreparedView,
    mesh: TetMesh,
    truth: torch.Tensor,
    valid: torch.Tensor | None,
    hats: HatChoice,
) -> None:
    if len(view.shape) != 2 or truth.shape != (*view.shape, 3):
        wanted = f"takes {(*view.shape, 3)}" if len(view.shape) == 2 else f"sees {view.shape}, which is no image"
        raise DiffTetError(f"The true image has shape {tuple(truth.shape)}; the camera {wanted}.")
    if 0 in view.shape:
        raise DiffTetError(f"The view has the shape {view.shape}, so it says nothing; pass one of a pixel at least.")
    if valid is not None and not (
        isinstance(valid, torch.Tensor) and valid.dtype == torch.bool and valid.shape == truth.shape[:2]
    ):
        raise DiffTetError(f"valid is {shown(valid)}; pass a bool tensor of shape {tuple(truth.shape[:2])}.")
    hats.require_fit(mesh)
