"""Gradient ascent of an image's entropy over poses of its camera."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from dataclasses import field as dataclass_field
from pathlib import Path
from types import NoneType
from typing import Any, Literal

import torch

from difftetvr.capture.orbit import DEFAULT_FOV_Y
from difftetvr.declared import require_declared
from difftetvr.errors import CameraError, FitError, MeshError, shown
from difftetvr.fitting.records.checkpoint import alone_with
from difftetvr.inputs import as_whole, require_type
from difftetvr.inverse.viewpoint.entropy import checked_colors, color_entropy, opacity_entropy, reference_colors
from difftetvr.inverse.viewpoint.poses import Poses
from difftetvr.inverse.viewpoint.record import SearchRecord, Viewpoint, problem_of
from difftetvr.mesh.field import Field
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.rendering import Camera, ScalarField, render

Measure = Literal["opacity", "color", "both"]

_FIRST_STEP, _LONGEST_STEP, _LAST_STEP = 0.25, 0.6, 1e-3  # radians, of distances of the orbit
_LONGER, _SHORTER = 1.6, 0.4
_APART = 1.8  # of starts, in distances of neighbouring scouts, which are about 2 / sqrt(count)


@dataclass(frozen=True)
class ViewpointConfig:
    """What is measured, and from where views may be taken.

    Attributes:
        measure: The entropy of the opacity, of the colours, or the sum of both.
        poses: Cameras on an orbit, which look at its centre from one distance; or free ones, whose distance and target
            may change by a quarter of it.
        starts: Number of poses from which the entropy is climbed, >= 1.
        scouts: Views that are rendered first, spread evenly over the orbit, so that climbs start from the best of them
            that are not neighbours; 0 renders none, and eight starts are the middles of the octants.
        iterations: Most renderings of each climb, >= 1.
        center: What the cameras of the orbit look at; None: the middle of the mesh's box.
        radius: Their distance from it; None: so far that the whole box is in sight.
        up: Direction that points upwards in pictures.
        fov_y: Vertical field of view in radians.
        width: Pixels.
        height: Pixels.
        renderer: How crossings are found, see :func:`difftetvr.render`.

    Raises:
        CameraError: A value is of the wrong kind or out of range.
    """

    measure: Measure = "opacity"
    poses: Literal["orbit", "free"] = "orbit"
    starts: int = 8
    scouts: int = 64
    iterations: int = 30
    center: tuple[float, float, float] | None = None
    radius: float | None = None
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    fov_y: float = DEFAULT_FOV_Y
    width: int = 128
    height: int = 128
    renderer: str = "marching"

    def __post_init__(self) -> None:
        require_declared(self, CameraError)
        for name in ("starts", "iterations", "width", "height"):
            if getattr(self, name) < 1:
                raise CameraError(f"{name} is {shown(getattr(self, name))}; it must be at least 1.")
        if self.scouts != 0 and self.scouts < self.starts:
            raise CameraError(
                f"scouts is {shown(self.scouts)} with {self.starts} starts; give at least as many scouts, or 0."
            )
        if not 0.0 < self.fov_y < math.pi:
            raise CameraError(f"fov_y is {self.fov_y} radians; it must lie between 0 and pi.")
        if self.radius is not None and not 0.0 < self.radius < math.inf:
            raise CameraError(f"The radius is {shown(self.radius)}; it must be finite and greater than 0.")
        for name in ("center", "up"):
            if getattr(self, name) is not None and not all(math.isfinite(v) for v in getattr(self, name)):
                raise CameraError(f"{name} is {shown(getattr(self, name))}; give three finite numbers.")
        if not math.hypot(*self.up) > 0.0:
            raise CameraError("up is no direction; give a vector that is not 0.")

    def poses_about(self, mesh: TetMesh) -> Poses:
        """The poses that views of a mesh may have."""
        lower, upper = mesh.bounds().detach().double().cpu()
        center = 0.5 * (lower + upper) if self.center is None else torch.tensor(self.center, dtype=torch.float64)
        radius = self.radius
        if radius is None:
            narrow = 2.0 * math.atan(math.tan(0.5 * self.fov_y) * min(1.0, self.width / self.height))
            radius = 0.5 * float((upper - lower).norm()) / math.sin(0.5 * narrow)
        if not 0.0 < radius < math.inf:
            raise MeshError(f"The mesh is {radius:.3g} across, of which no picture can be computed; scale it.")
        up = torch.tensor(self.up, dtype=torch.float64)
        return Poses(center, radius, up / up.norm(), self.fov_y, self.width, self.height, self.poses == "free")


@dataclass(frozen=True)
class ViewpointSearch:
    """What a search has found.

    Attributes:
        found: Where each climb ended, the best first.
        paths: All views that each climb went through, from its start to its end, in the order of ``found``.
        scouts: Views that were rendered first, along a spiral over the sphere; none where the options ask for none.
        center: (3,) float64 what the cameras of the orbit look at.
        renderings: Images that were rendered, those of the scouts without gradients, all others with them.
    """

    found: tuple[Viewpoint, ...]
    paths: tuple[tuple[Viewpoint, ...], ...]
    scouts: tuple[Viewpoint, ...]
    center: torch.Tensor
    renderings: int

    @property
    def best(self) -> Viewpoint:
        """The view with the greatest entropy."""
        return self.found[0]

    @property
    def worst(self) -> Viewpoint:
        """The view with the least entropy of all scouts and of where climbs began."""
        return min((*self.scouts, *(path[0] for path in self.paths)), key=lambda view: view.entropy)


def best_viewpoint(
    mesh: TetMesh,
    field: Field | ScalarField,
    config: ViewpointConfig | None = None,
    *,
    colors: Any = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    on_progress: Callable[[int, int], None] | None = None,
) -> ViewpointSearch:
    """Climbs the entropy of the image over poses of its camera, from several starts.

    Each climb goes along the gradient by steps of an adaptive length, a step that does not gain is taken back and
    tried shorter; it ends when steps fall below a thousandth of the distance. All that is random is left out: the same
    arguments give the same views, to the last bit on CPUs, also when the search was interrupted and resumed.

    Args:
        mesh: The mesh.
        field: What it holds, see :func:`difftetvr.render`.
        config: What is measured, and from where; default: the opacity's entropy from an orbit.
        colors: (K, 3) colours whose areas are compared; default: :func:`difftetvr.inverse.reference_colors`.
        checkpoint: File (JSON) to which the scouts and every climb that has ended are saved; that of an earlier search
            is replaced, no other file is.
        resume: Go on from ``checkpoint`` if it exists.
        on_progress: Called with the number of climbs that have ended, and of all; first once the scouts are rendered.

    Returns:
        The views found, the best first.

    Raises:
        CameraError: Nothing is seen from any start, or a colour is wanted where there is none.
        MeshError: See :func:`difftetvr.render`.
        FitError: The checkpoint cannot be used.
    """
    require_type(checkpoint, (str, os.PathLike, NoneType), "checkpoint", "pass the name of a file", FitError)
    path = None if checkpoint is None else Path(checkpoint)
    with contextlib.ExitStack() as stack:
        # Climbs follow gradients, whatever a caller has switched off around them.
        stack.enter_context(torch.inference_mode(False))
        stack.enter_context(torch.enable_grad())
        look = _Look.of(mesh, field, config, colors)
        climbs: list[list[Viewpoint]] = []
        if path is not None:
            stack.enter_context(alone_with(path))
            if path.exists():
                climbs = look.taken_over(path) if resume else look.replaced(path)
        starts = look.starts()
        for count in range(len(climbs), len(starts) + 1):
            if count > len(climbs):
                climbs.append(look.climb(starts[count - 1]))
            if path is not None:
                look.record(climbs).save(path)
            if on_progress is not None:
                on_progress(count, len(starts))
    look.require_anything()
    climbs.sort(key=lambda path: -path[-1].entropy)
    found = tuple(path[-1] for path in climbs)
    return ViewpointSearch(found, tuple(map(tuple, climbs)), tuple(look.scouts), look.poses.center, look.renderings)


def sample_viewpoints(
    mesh: TetMesh,
    field: Field | ScalarField,
    count: int = 256,
    config: ViewpointConfig | None = None,
    *,
    colors: Any = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> tuple[Viewpoint, ...]:
    """Views from evenly spread places of the orbit and their entropies: what a search is held against.

    Args:
        mesh: The mesh.
        field: What it holds.
        count: Number of views, >= 1.
        config: What is measured, and from where.
        colors: As for :func:`difftetvr.best_viewpoint`.
        on_progress: Called with the number of views rendered, and of all.

    Returns:
        The views, along a Fibonacci spiral over the sphere.

    Raises:
        CameraError: The count is out of range, or nothing is seen from anywhere.
        MeshError: See :func:`difftetvr.render`.
    """
    count = as_whole(count, "The number of views", CameraError)
    if count < 1:
        raise CameraError(f"The number of views is {shown(count)}; give at least one.")
    look = _Look.of(mesh, field, config, colors)
    views = []
    with torch.no_grad():
        for index, pose in enumerate(look.poses.spread(count)):
            views.append(look.view(pose)[0])
            if on_progress is not None:
                on_progress(index + 1, count)
    look.require_anything()
    return tuple(views)


@dataclass
class _Look:
    """Looks at a volume and keeps count."""

    mesh: TetMesh
    field: Field | ScalarField
    config: ViewpointConfig
    poses: Poses
    references: torch.Tensor | None
    scouts: list[Viewpoint] = dataclass_field(default_factory=list)
    renderings: int = 0
    most_seen: float = 0.0

    @staticmethod
    def of(mesh: Any, field: Any, config: Any, colors: Any) -> _Look:
        require_type(mesh, TetMesh, "mesh", "pass a difftetvr.TetMesh", MeshError)
        require_type(field, (Field, ScalarField), "field", "pass a difftetvr.Field or ScalarField", MeshError)
        require_type(config, (ViewpointConfig, NoneType), "config", "pass a ViewpointConfig", CameraError)
        chosen = config or ViewpointConfig()
        references = None
        if chosen.measure != "opacity":
            references = reference_colors(field) if colors is None else checked_colors(colors)
        mesh = mesh.with_vertices(mesh.vertices.detach())
        return _Look(mesh, field, chosen, chosen.poses_about(mesh), references)

    def entropy(self, camera: Camera) -> torch.Tensor:
        on_cpu = self.mesh.vertices.is_cpu
        image = render(self.mesh, self.field, camera, renderer=self.config.renderer, deterministic=on_cpu)
        self.renderings += 1
        self.most_seen = max(self.most_seen, float(image.alpha.detach().max()))
        total = image.alpha.new_zeros(())
        if self.config.measure != "color":
            total = total + opacity_entropy(image.alpha)
        if self.references is not None:
            total = total + color_entropy(image.color, self.references)
        return total

    def view(self, pose: torch.Tensor) -> tuple[Viewpoint, torch.Tensor]:
        """The view of a pose, and the direction in which it gains."""
        variable = pose.clone().requires_grad_(torch.is_grad_enabled())
        camera = self.poses.camera(variable)
        entropy = self.entropy(camera)
        seen = Viewpoint(camera.with_pose(camera.world_to_camera.detach()), float(entropy.detach()))
        if not torch.is_grad_enabled():
            return seen, torch.zeros_like(pose)
        (gradient,) = torch.autograd.grad(entropy, variable) if entropy.requires_grad else (torch.zeros_like(pose),)
        return seen, self.poses.uphill(pose, gradient)

    def starts(self) -> list[torch.Tensor]:
        """Poses to climb from."""
        count = self.config.starts
        if not self.config.scouts:
            return self.poses.starts(count)
        scouts = self.poses.spread(self.config.scouts)
        with torch.no_grad():
            self.scouts += [self.view(pose)[0] for pose in scouts[len(self.scouts) :]]
        order = sorted(range(len(scouts)), key=lambda scout: -self.scouts[scout].entropy)
        # Each scout stands for its share of the sphere; best ones side by side would climb one hill.
        apart = 2.0 * _APART / math.sqrt(len(scouts))
        chosen: list[int] = []
        for scout in order:
            if all(float((scouts[scout] - scouts[other]).norm()) > apart for other in chosen):
                chosen.append(scout)
        rest = [scout for scout in order if scout not in chosen]
        return [scouts[scout] for scout in (chosen + rest)[:count]]

    @functools.cached_property
    def problem(self) -> str:
        """What tells this search from others."""
        return problem_of(self.mesh, self.field, dataclasses.asdict(self.config), self.references)

    def record(self, climbs: list[list[Viewpoint]]) -> SearchRecord:
        """What has been found so far."""
        return SearchRecord(self.problem, self.renderings, self.most_seen, self.scouts, climbs)

    def taken_over(self, path: Path) -> list[list[Viewpoint]]:
        """The climbs of an earlier search, whose scouts are taken over.

        Raises:
            FitError: It is none, or one of something else.
        """
        saved = self._saved(path)
        saved.require(self.problem, path)
        if len(saved.scouts) != self.config.scouts or len(saved.climbs) > self.config.starts:
            raise FitError(f"The search in {path} does not fit its own options; start anew.")
        self.renderings, self.most_seen, self.scouts = saved.renderings, saved.most_seen, saved.scouts
        return saved.climbs

    def replaced(self, path: Path) -> list[list[Viewpoint]]:
        """No climbs, after a look at what a search that begins anew will write over.

        Raises:
            FitError: It is no search.
        """
        self._saved(path)
        return []

    def _saved(self, path: Path) -> SearchRecord:
        return SearchRecord.load(path, self.poses.camera(self.poses.spread(1)[0]))

    def climb(self, pose: torch.Tensor) -> list[Viewpoint]:
        """The views from a start uphill."""
        seen, uphill = self.view(pose)
        path, step = [seen], _FIRST_STEP
        for _ in range(self.config.iterations - 1):
            length = float(uphill.norm())
            if not length > 0.0 or step < _LAST_STEP:
                break
            tried = self.poses.valid(pose + (step / length) * uphill)
            seen, direction = self.view(tried)
            if seen.entropy > path[-1].entropy:
                path.append(seen)
                pose, uphill, step = tried, direction, min(_LONGER * step, _LONGEST_STEP)
            else:
                step *= _SHORTER
        return path

    def require_anything(self) -> None:
        if not self.most_seen > 0.0:
            raise CameraError(
                "Nothing is seen from anywhere; change the transfer function, the densities or the orbit."
            )
