"""Gradient and Gauss-Newton matrix of an image's squared error by hat functions on vertices, edges and faces."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch

from difftetvr.backend import eager
from difftetvr.errors import DiffTetError, MeshError, shown
from difftetvr.inputs import as_reals, require_type
from difftetvr.memory import tried_twice
from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering.api import as_background
from difftetvr.rendering.kernels.composition import Composition
from difftetvr.rendering.kernels.forward import render_forward
from difftetvr.rendering.kernels.hats.absorption import RECORD as ABSORPTION_RECORD
from difftetvr.rendering.kernels.hats.absorption import IntegralErrors, absorption_records
from difftetvr.rendering.kernels.hats.kernel import STEP_RECORD, HatSpace
from difftetvr.rendering.kernels.hats.light import RECORD, HatImage, hat_records
from difftetvr.rendering.preparation import PreparedView, ViewOptions, prepare_view
from difftetvr.rendering.rays import Rays, RaySource

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


@eager
@tried_twice
@torch.no_grad()
def model_image(
    mesh: TetMesh,
    field: Field,
    camera: RaySource | Rays,
    truth: torch.Tensor,
    background: torch.Tensor | tuple[float, float, float] | None = None,
    transmittance_threshold: float = 1e-4,
    deterministic: bool = False,
    valid: torch.Tensor | None = None,
    face_steps: torch.Tensor | None = None,
) -> ImageModel:
    """Renders a view, and predicts what changes of the mesh would do to its squared error.

    The responses of pixels to hat functions are integrated with four pieces a crossing (article Algorithm 1, with the
    rest of the ray exact), so they are approximate: by a per cent or so where cells are not optically thick.

    Args:
        mesh: Mesh.
        field: Its colours and densities, on vertices.
        camera: Camera of the view, or rays that are an image, (H, W).
        truth: (H, W, 3) what the image should be, on the mesh's device.
        background: (3,) linear RGB behind the volume; black if None.
        transmittance_threshold: Rays stop once their transmittance is at or below this value.
        deterministic: Whether sums are the same in every run to the last bit, see :func:`difftetvr.render`.
        valid: (H, W) bool, pixels that have an error; None: all. The curvature counts all of them.
        face_steps: (F, 4) the one step of each face's hat that is looked at, in the order of ``mesh.topology.faces``:
            a third less work than for all steps. Steps of 0 cost nothing.

    Returns:
        The model, in the precision and on the device of the mesh.

    Raises:
        MeshError: The field does not fit the mesh, lives on cells, or holds invalid values.
        DiffTetError: The truth has another size than the camera's image, or an argument is out of range.
        BackendError: No back end runs on the device of the mesh.
    """
    require_type(field, Field, "field", "pass a difftetvr.Field", DiffTetError)
    options = ViewOptions(transmittance_threshold=transmittance_threshold, deterministic=deterministic)
    view = prepare_view(mesh, field, camera, options)
    if view.task.content != "vertex":
        raise MeshError("The field lives on cells; hat functions need colours and densities on vertices.")
    truth = as_reals(truth, "The true image", DiffTetError)
    if len(view.shape) != 2 or truth.shape != (*view.shape, 3):
        wanted = f"takes {(*view.shape, 3)}" if len(view.shape) == 2 else f"sees {view.shape}, which is no image"
        raise DiffTetError(f"The true image has shape {tuple(truth.shape)}; the camera {wanted}.")
    if valid is not None and not (
        isinstance(valid, torch.Tensor) and valid.dtype == torch.bool and valid.shape == truth.shape[:2]
    ):
        raise DiffTetError(f"valid is {shown(valid)}; pass a bool tensor of shape {tuple(truth.shape[:2])}.")
    if face_steps is not None and face_steps.shape != (mesh.topology.faces.shape[0], 4):
        count = mesh.topology.faces.shape[0]
        raise DiffTetError(f"face_steps has shape {tuple(face_steps.shape)}; this mesh takes {(count, 4)}.")
    behind = as_background(background, mesh.vertices)
    backend = view.task.backend
    tracer = view.tracer(view.limits(None))
    with backend.exclusive(deterministic):
        how = Composition(None if behind is None else backend.floats(behind), None, view.unit)
        rendered = render_forward(tracer, how)
        image = backend.tensor(rendered.image.color, *truth.shape)
        residual = image - truth.to(image)
        if valid is not None:
            residual = residual * valid.to(residual.device)[..., None]
        curvature = 2.0 / residual.numel()
        steps = None
        if face_steps is not None:
            steps = backend.floats(torch.cat((face_steps[:, :3], face_steps[:, 3:] * view.unit), 1))
        records = hat_records(
            tracer,
            mesh,
            view.upload.order,
            HatImage(backend.floats(image), backend.floats(curvature * residual), steps),
            deterministic,
        )
        rows = backend.tensor(records.vertices, -1, RECORD)[: mesh.num_vertices]
        edges = backend.tensor(records.edges, -1, RECORD)[: mesh.topology.edges.shape[0]]
        faces = backend.tensor(records.faces, -1, RECORD if steps is None else STEP_RECORD)
        faces = faces[: mesh.topology.faces.shape[0]]
    vertices = _in_order_of_mesh(rows, view)
    return ImageModel(
        _derivatives(vertices, curvature).with_density_unit(view.unit),
        _derivatives(edges, curvature).with_density_unit(view.unit),
        _derivatives(faces, curvature).with_density_unit(view.unit) if steps is None else None,
        float(residual.square().mean()),
        None if steps is None else StepDerivatives(faces[:, 0], curvature * faces[:, 1]),
    )


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
        DiffTetError: An argument has a wrong shape.
        BackendError: No back end runs on the device of the mesh.
    """
    topology = mesh.topology
    view = prepare_view(mesh, Field(density.new_zeros(len(density), 0), density, "vertex"), camera, ViewOptions())
    wanted = [(view.shape, errors[0]), (view.shape, errors[1]), ((topology.faces.shape[0],), face_steps)]
    for shape, tensor in wanted:
        if tuple(tensor.shape) != tuple(shape):
            raise DiffTetError(f"A derivative or step has shape {tuple(tensor.shape)}; this view takes {tuple(shape)}.")
    backend = view.task.backend
    tracer = view.tracer(view.limits(None))
    with backend.exclusive(deterministic):
        slopes, curvatures, steps = (
            backend.floats(part.reshape(-1)) for part in (*errors, face_steps.to(mesh.vertices) * view.unit)
        )
        space = HatSpace.of(mesh, view.upload.order, [ABSORPTION_RECORD, ABSORPTION_RECORD, STEP_RECORD])
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
        _of_density(_in_order_of_mesh(rows, view)).with_density_unit(view.unit),
        _of_density(edges).with_density_unit(view.unit),
        None,
        0.0,
        StepDerivatives(faces[:, 0], faces[:, 1]),
    )


def _in_order_of_mesh(rows: torch.Tensor, view: PreparedView) -> torch.Tensor:
    """Records of vertices, which kernels number in the order of memory."""
    return torch.empty_like(rows).index_copy_(0, view.upload.order.vertices.long(), rows)


def _of_density(records: torch.Tensor) -> HatDerivatives:
    """Models that know of nothing but density."""
    zero = records.new_zeros(())
    gradient = torch.nn.functional.pad(records[:, :1], (3, 0))
    count = len(records)
    return HatDerivatives(gradient, zero.expand(count), zero.expand(count, 3), records[:, 1], zero.expand(count))


def _derivatives(records: torch.Tensor, curvature: float) -> HatDerivatives:
    seconds = curvature * records[:, 4:9]
    return HatDerivatives(records[:, :4], seconds[:, 0], seconds[:, 1:4], seconds[:, 4], records[:, 9])
