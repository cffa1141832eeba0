"""Projections as the voxel peers see them: weights, training and held-out views, and coarser copies."""

from __future__ import annotations

import dataclasses

import torch
from tomography_projector import VoxelProjector

from difftetvr.capture import ProjectionCapture, ProjectionGeometry
from difftetvr.fitting.metrics import psnr_of_mse


@dataclasses.dataclass(frozen=True)
class VoxelScan:
    """A scan to be reconstructed with voxels.

    Attributes:
        capture: The projections.
        measured: (V, pixels) line integrals; 0 where they do not count.
        weight: (V, pixels) one over their variances, in units of the mean of these; 0 where they do not count.
        precision: That unit.
        train, test: Views to learn from, and held-out ones.
    """

    capture: ProjectionCapture
    measured: torch.Tensor
    weight: torch.Tensor
    precision: float
    train: list[int]
    test: list[int]

    @staticmethod
    def of(capture: ProjectionCapture) -> VoxelScan:
        """All of a capture; noise that it does not tell is the same everywhere, and of deviation 1."""
        values = capture.line_integrals.flatten(1)
        weight = torch.ones_like(values) if capture.variance is None else 1.0 / capture.variance.flatten(1)
        if capture.valid is not None:
            values, weight = (torch.where(capture.valid.flatten(1), part, 0.0) for part in (values, weight))
        precision = float(weight.double().mean())
        train, test = capture.train_indices.tolist(), capture.test_indices.tolist()
        return VoxelScan(capture, values, weight / precision, precision, train, test)

    @property
    def geometry(self) -> ProjectionGeometry:
        """The geometry of all views."""
        return self.capture.geometry

    @property
    def peak(self) -> float:
        """The greatest line integral that counts."""
        return float(self.measured[self.weight > 0].max())

    def mean_density(self, projector: VoxelProjector) -> float:
        """Sum of the line integrals over that of the rays' ways through the box."""
        seen = way = 0.0
        for view in self.train:
            length = projector.lengths([view])[0]
            counts = (self.weight[view] > 0) & (length > 0)
            seen += float(self.measured[view][counts].double().sum())
            way += float(length[counts].double().sum())
        return seen / way

    def held_out_psnr(self, volume: torch.Tensor, projector: VoxelProjector) -> float:
        """Mean PSNR in dB of the held-out views as measured, noise and all; NaN without any."""
        found = []
        for view in self.test:
            counts = self.weight[view] > 0
            error = (projector.forward(volume, [view])[0] - self.measured[view])[counts].double().square().mean()
            found.append(psnr_of_mse(float(error) / self.peak**2))
        return sum(found) / len(found) if found else float("nan")

    def subsets(self, count: int) -> list[list[int]]:
        """The training views in so many interleaved groups, in an order in which neighbours are far apart."""
        count = min(count, len(self.train))
        ratio = 0.6180339887498949
        order = sorted(range(count), key=lambda k: (k * ratio) % 1.0)
        return [self.train[k::count] for k in order]


def binned(capture: ProjectionCapture, factor: int) -> ProjectionCapture:
    """The capture with the means of ``factor`` x ``factor`` pixels; those with an invalid one are invalid.

    Pixels at the right and the lower edge that fill no whole square are left out.
    """
    if factor == 1:
        return capture
    views, height, width = capture.geometry.shape
    high, wide = height // factor, width // factor

    def mean(values: torch.Tensor) -> torch.Tensor:
        cut = values[:, : high * factor, : wide * factor]
        return cut.reshape(views, high, factor, wide, factor).mean((2, 4))

    detector = capture.geometry.detector
    lost = (0.5 * (high * factor - height), 0.5 * (wide * factor - width))
    detector = dataclasses.replace(
        detector,
        center=detector.center + lost[0] * detector.rows + lost[1] * detector.columns,
        columns=factor * detector.columns,
        rows=factor * detector.rows,
        width=wide,
        height=high,
    )
    geometry = dataclasses.replace(capture.geometry, detector=detector)
    variance, valid = capture.variance, capture.valid
    return ProjectionCapture(
        geometry,
        mean(capture.line_integrals),
        None if variance is None else mean(variance) / factor**2,
        None if valid is None else mean(valid.float()) == 1.0,
        capture.test,
        capture.name,
    )
