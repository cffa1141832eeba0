"""Corrections of a scan's geometry that are learned with the densities: where the axis is, how views are shifted.

All of them move the detector in its own plane, in pixels, and images are differentiable in where it is. A shift of all
views along the rows is where the axis of rotation is seen; one across them cannot be told from a shift of the object
and is learned for single views alone.
"""

from __future__ import annotations

import dataclasses
import math

import torch

from difftetvr.fitting.parameters import CarriedAdam
from difftetvr.inverse.tomography.config import Refined
from difftetvr.rendering.cameras.detector import Detector

_BETAS = (0.9, 0.99)
_TILT_PER_PIXEL = 2.0  # a step of the tilt moves the ends of a row by about as much as one of the shift moves all
_LEAST_HEIGHT = 0.125
"""Of a detector of which a tilt is learned, in widths: the ends of few rows would leave all that is reconstructed."""


class Alignment:
    """Corrections under optimisation, with their Adam optimiser.

    Attributes:
        shift: (2,) shift of all views along rows and columns of pixels, in pixels; the second one stays 0.
        tilt: () rotation of all detectors in their plane, in radians; 0 where they have few rows beside their columns.
        of_views: (V, 2) shifts of single views besides, in pixels; none for views that are held out.
    """

    def __init__(self, kind: Refined, size: tuple[int, int, int], device: torch.device, shift: float = 0.0) -> None:
        """Nothing is learned yet.

        Args:
            kind: What is to be.
            size: Views, rows and columns.
            device: Where densities are.
            shift: Where the axis is taken to be, in pixels.
        """
        views, height, width = size
        self.shift = torch.tensor([shift, 0.0], dtype=torch.float64, device=device)
        self.tilt = torch.zeros((), dtype=torch.float64, device=device)
        self.of_views = torch.zeros(views, 2, dtype=torch.float64, device=device)
        tilt = ["tilt"] if height >= _LEAST_HEIGHT * width else []
        learned = {"none": [], "axis": ["shift", *tilt], "views": ["shift", *tilt, "of_views"]}[kind]
        self._leaves: dict[str, torch.Tensor] = {name: getattr(self, name).requires_grad_() for name in learned}
        self._rates = [_TILT_PER_PIXEL / width if name == "tilt" else 1.0 for name in learned]
        self._optimizer = CarriedAdam([[leaf] for leaf in self._leaves.values()], _BETAS) if learned else None

    @property
    def is_learned(self) -> bool:
        """Whether anything is corrected."""
        return bool(self._leaves)

    def applied(self, detector: Detector, view: int) -> Detector:
        """The detector of a view where the corrections put it; differentiable in them.

        Args:
            detector: Where it was said to be.
            view: Number of the view.
        """
        if not self.is_learned:
            return detector
        columns, rows = detector.columns.to(self.tilt.device), detector.rows.to(self.tilt.device)
        normal = torch.linalg.cross(columns, rows)
        normal = normal / normal.norm()
        cosine, sine = torch.cos(self.tilt), torch.sin(self.tilt)
        columns, rows = (cosine * part + sine * torch.linalg.cross(normal, part) for part in (columns, rows))
        shift = self.shift + self.of_views[view]
        center = detector.center.to(self.tilt.device) + shift[0] * columns + shift[1] * rows
        return dataclasses.replace(detector, center=center, columns=columns, rows=rows)

    def to_json(self) -> dict[str, float]:
        """What holds for all views, as JSON values; without what is not learned."""
        if not self.is_learned:
            return {}
        found = {"axis_shift_pixels": float(self.shift[0].detach())}
        if "tilt" in self._leaves:
            found["axis_tilt_degrees"] = math.degrees(float(self.tilt.detach()))
        return found

    def zero_grad(self) -> None:
        """Forgets the gradients."""
        if self._optimizer is not None:
            self._optimizer.zero_grad()

    def step(self, rate: float) -> None:
        """One step with the accumulated gradients.

        Args:
            rate: Its length, in pixels.
        """
        if self._optimizer is None:
            return
        if self.shift.grad is not None:
            self.shift.grad[1] = 0.0
        self._optimizer.step([share * rate for share in self._rates])

    def state(self) -> dict[str, torch.Tensor]:
        """Corrections and optimiser state by name."""
        if self._optimizer is None:
            return {}
        tensors = {}
        for name, leaf in self._leaves.items():
            tensors[f"alignment.{name}"] = leaf
            for key, value in self._optimizer.state(leaf).items():
                tensors[f"alignment.{name}.{key}"] = value
        return tensors

    def restore(self, tensors: dict[str, torch.Tensor]) -> None:
        """The inverse of :meth:`state`."""
        with torch.no_grad():
            for name, tensor in self.state().items():
                tensor.copy_(tensors[name])
