"""Projections where kernels see them: some or all pixels of a view, as a camera and what it measured."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import torch

from difftetvr.capture.projections.geometry import ProjectionGeometry
from difftetvr.capture.projections.noise import estimated_noise
from difftetvr.capture.projections.projection_capture import ProjectionCapture
from difftetvr.errors import FitError
from difftetvr.inverse.tomography.alignment import Alignment
from difftetvr.mesh.field import Field
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.rendering import render
from difftetvr.rendering.cameras.detector import Detector
from difftetvr.rendering.cameras.pinhole import Camera

_SQUARE = 1e-9  # cosine up to which rows and columns of a detector count as perpendicular
_LEAST_NOISE = 1e-4  # of the greatest line integral: where noise is estimated and there is next to none
_LEAST = 1e-30
_LEAST_PEAK = 1e-9  # line integral: whoever measures less has measured noise
_CUT_OFF = 0.05  # at a detector's edge, of the greatest shadow: what is cut off has no centre
_LEAST_SINE = 8
_UNIT_RAYS = 16_384


@dataclass(frozen=True)
class PixelSet:
    """Pixels of one view at equal steps.

    Attributes:
        camera: What sees along their rays.
        measured: (h, w) line integrals.
        weight: (h, w) one over their variances; 0 where they do not count.
    """

    camera: Camera | Detector
    measured: torch.Tensor
    weight: torch.Tensor

    @property
    def count(self) -> int:
        """Number of pixels."""
        return self.measured.numel()


class Measurements:
    """A scan on a device.

    Attributes:
        capture: The scan.
        device: Where its numbers are.
        train, test: Views to learn from, and held-out ones.
        density_unit: Mean density in the box to reconstruct, as the views show it.
        peak: Greatest valid line integral.
    """

    def __init__(self, capture: ProjectionCapture, device: torch.device) -> None:
        """Brings a scan to a device.

        Raises:
            FitError: Nothing absorbs, or there is no valid pixel to learn from.
        """
        self.capture, self.device = capture, device
        self.train: list[int] = capture.train_indices.tolist()
        self.test: list[int] = capture.test_indices.tolist()
        self._is_before_detector = box_is_before_detector(capture.geometry)
        self._measured = capture.line_integrals.to(device)
        valid = torch.ones_like(self._measured, dtype=torch.bool) if capture.valid is None else capture.valid.to(device)
        self._measured = torch.where(valid, self._measured, 0.0)
        self.peak = float(self._measured.max())
        if self.peak < _LEAST_PEAK:
            raise FitError(
                f"Nothing absorbs in '{capture.name}': its greatest line integral is {self.peak:.3g}; check its sign, "
                "its flat field, and whether rays meet the object."
            )
        weight = 1.0 / capture.variance if capture.variance is not None else self._estimated_weight()
        self._weight = torch.where(valid, weight.to(device), 0.0)
        if not bool((self._weight[self.train] > 0).any()):
            raise FitError(f"No pixel of the views of '{capture.name}' to learn from is valid; check the mask.")
        self.density_unit = self._mean_density()

    @property
    def all_pixels(self) -> int:
        """Pixels of a view."""
        return math.prod(self._measured.shape[1:])

    def pixels(
        self, view: int, count: int, phase: tuple[float, float] = (0.5, 0.5), alignment: Alignment | None = None
    ) -> PixelSet:
        """About so many pixels of a view in equal steps along rows and columns; all where there are no more.

        Args:
            view: Number of the view.
            count: How many pixels are wanted, at most.
            phase: Where in a step of rows and of columns they begin, in [0, 1).
            alignment: Corrections of the geometry; what they move is differentiable in them.
        """
        height, width = self._measured.shape[1:]
        down, across = steps_for(height, width, count)
        first = (min(int(phase[0] * down), height - 1), min(int(phase[1] * across), width - 1))
        measured, weight = (part[view, first[0] :: down, first[1] :: across] for part in (self._measured, self._weight))
        detector = self.capture.geometry.view(view)
        if alignment is not None:
            detector = alignment.applied(detector, view)
        detector = strided(detector, first, (down, across), tuple(measured.shape))
        if not self._is_before_detector or detector.center.requires_grad:
            return PixelSet(detector, measured, weight)
        if (camera := as_camera(detector)) is not None:
            return PixelSet(camera, measured, weight)
        mirrored = as_camera(dataclasses.replace(detector, columns=-detector.columns))
        if mirrored is not None:
            return PixelSet(mirrored, measured.flip(1), weight.flip(1))
        return PixelSet(detector, measured, weight)

    def axis_shift(self) -> float:
        """Pixels by which the detector has to move along its rows so that the axis, z, is where its views turn around.

        The centre of what a parallel view absorbs swings around the axis as a sine of the angle (the first moment of
        Helgason and Ludwig's conditions), and nearly so that of a cone beam. 0 where angles are not known, or are fewer
        than tell a sine, or the detector sees but a part of the object.
        """
        angles = self.capture.geometry.angles
        views = [view for view in self.train if bool((self._weight[view] > 0).any())]
        if angles is None or len(views) < _LEAST_SINE:
            return 0.0
        width = self._measured.shape[2]
        seen = torch.where(self._weight[views] > 0, self._measured[views], 0.0).clamp(min=0.0).double().sum(1).cpu()
        place = torch.arange(width, dtype=torch.float64) + 0.5 - 0.5 * width
        edges = seen[:, [0, -1]].amax(1) / seen.amax(1).clamp(min=_LEAST)
        if float(edges.median()) > _CUT_OFF:
            return 0.0
        mass = seen.sum(1)
        centers = (seen * place).sum(1) / mass.clamp(min=_LEAST) - axis_places(self.capture.geometry.detector)[views]
        turns = torch.deg2rad(angles[views])
        sines = torch.stack((torch.ones_like(turns), torch.cos(turns), torch.sin(turns)), 1)
        fitted = torch.linalg.lstsq(sines, centers[:, None]).solution[0, 0]
        return -float(fitted) if bool((mass > 0).all()) else 0.0

    def _estimated_weight(self) -> torch.Tensor:
        """(V, H, W) one over the variance of noise that is the same everywhere; without any, of little noise."""
        values, valid = self.capture.line_integrals, self.capture.valid
        if valid is not None:
            values = torch.where(valid, values, torch.nan)
        largest = float(values.abs().nan_to_num(0.0).max())
        noise = estimated_noise(values)
        noise = largest if noise is None else max(noise, _LEAST_NOISE * largest)
        return torch.full_like(values, 1.0 / noise**2)

    def _mean_density(self) -> float:
        """Sum of all line integrals over that of the rays' ways through the box."""
        low, high = self.capture.geometry.bounds.tolist()
        box = TetMesh.grid((1, 1, 1), low, high)
        ones = torch.ones(box.num_vertices)
        seen = way = 0.0
        for view in self.train:
            part = self.pixels(view, _UNIT_RAYS // max(1, len(self.train)) + 64)
            length = render(box, Field(ones.new_zeros(len(ones), 0), ones), part.camera).optical_depth
            counts = (part.weight.cpu() > 0) & (length > 0)
            seen += float(part.measured.cpu()[counts].double().sum())
            way += float(length[counts].double().sum())
        mean = seen / way if way > 0 else 0.0
        if mean > 0:
            return mean
        sides = [b - a for a, b in zip(low, high, strict=True)]
        return max(self.peak, _LEAST) / max(sides)


def steps_for(height: int, width: int, count: int) -> tuple[int, int]:
    """Steps down and across an image of which about so many pixels are taken, at most; equal as far as it goes."""
    if height * width <= count:
        return 1, 1
    down = min(height, max(1, round(math.sqrt(height * width / count))))
    rows = -(-height // down)
    return down, max(1, math.ceil(width * rows / max(count, 1)))


def strided(detector: Detector, first: tuple[int, int], steps: tuple[int, int], shape: tuple[int, ...]) -> Detector:
    """The detector of one view that has every so many pixels, with the same rays.

    Args:
        detector: The detector.
        first: Row and column of the first pixel.
        steps: Pixels down and across from one to the next.
        shape: How many there are, down and across.
    """
    if steps == (1, 1):
        return detector
    offsets = [
        start + 0.5 * (step * (count - 1) + 1 - size)
        for start, step, count, size in zip(first, steps, shape, (detector.height, detector.width), strict=True)
    ]
    return dataclasses.replace(
        detector,
        center=detector.center + offsets[0] * detector.rows + offsets[1] * detector.columns,
        rows=steps[0] * detector.rows,
        columns=steps[1] * detector.columns,
        height=shape[0],
        width=shape[1],
    )


def as_camera(detector: Detector) -> Camera | None:
    """The pinhole camera that sees along the rays of a detector with a source, whose entries are found faster.

    None where there is no such camera: for parallel rays, and where the detector is seen mirrored or its sides are not
    perpendicular. Nothing of the object may lie behind the detector.
    """
    if detector.source is None:
        return None
    across, down = detector.columns.norm(), detector.rows.norm()
    right, below = detector.columns / across, detector.rows / down
    forward = torch.linalg.cross(right, below)
    to_center = detector.center - detector.source
    distance = float(to_center @ forward)
    if abs(float(right @ below)) > _SQUARE or distance <= 0:
        return None
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack((right, below, forward))
    pose[:3, 3] = -pose[:3, :3] @ detector.source
    fx, fy = distance / float(across), distance / float(down)
    cx = 0.5 * detector.width - float(to_center @ right) / float(across)
    cy = 0.5 * detector.height - float(to_center @ below) / float(down)
    return Camera(pose, fx, fy, cx, cy, detector.width, detector.height)


def axis_places(detector: Detector) -> torch.Tensor:
    """(B,) float64 pixels from the middle of a detector along its rows at which each view sees the z axis."""
    center, columns, rows = (
        part.double().cpu().reshape(-1, 3) for part in (detector.center, detector.columns, detector.rows)
    )
    on_axis = center * torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    if detector.source is not None:
        along = on_axis - detector.source.double().cpu()
    else:
        assert detector.direction is not None
        along = detector.direction.double().cpu().reshape(-1, 3)
    center, columns, rows, on_axis, along = torch.broadcast_tensors(center, columns, rows, on_axis, along)
    # Detectors whose vectors lie in a plane see no point of the axis: the pseudoinverse says something of them, too.
    solved = torch.linalg.pinv(torch.stack((columns, rows, along), dim=2)) @ (on_axis - center)[..., None]
    return solved[:, 0, 0]


def box_is_before_detector(geometry: ProjectionGeometry) -> bool:
    """Whether in all views the box to reconstruct lies on the source's side of the detector."""
    low, high = geometry.bounds
    detector = geometry.detector
    if detector.source is None:
        return True
    corners = torch.cartesian_prod(*torch.stack((low, high)).T)
    normal = torch.linalg.cross(detector.columns, detector.rows)
    side = torch.sign(((detector.center - detector.source) * normal).sum(-1))
    heights = ((corners[None] - detector.center[:, None]) * normal[:, None]).sum(-1) * side[:, None]
    return bool((heights <= 0).all())
