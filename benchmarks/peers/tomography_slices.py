"""Parallel projections as packages for slices want them: pixels as wide as voxels, and a row of them for each slice."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from tomography_scan import VoxelScan

from difftetvr.errors import CaptureError

_EQUAL = 1e-6  # in pixels, and of unit vectors


@dataclass(frozen=True)
class Slices:
    """The training views of a scan, slice by slice.

    Attributes:
        sinograms: (N, V, W) float32 line integrals over the pitch, as if pixels had side 1: slices from the least z up,
            views, columns.
        weights: (N, V, W) float32 one over variances, in units of their mean; 0 where pixels do not count.
        degrees: (V,) angles at which columns run along (-sin, cos, 0).
        pitch: Side of a pixel and of a voxel, in the unit of the geometry.
    """

    sinograms: np.ndarray
    weights: np.ndarray
    degrees: np.ndarray
    pitch: float

    @staticmethod
    def of(scan: VoxelScan) -> Slices:
        """The training views.

        Raises:
            CaptureError: They are no upright parallel projections around the middle of a cube of such voxels.
        """
        geometry = scan.geometry.select(scan.train)
        detector = geometry.detector
        if detector.direction is None:
            raise CaptureError(
                "The rays come from a source; slices need a scan of parallel rays, such as of the type 'parallel'."
            )
        columns, rows, center, direction = (
            part.double().expand(geometry.num_views, 3)
            for part in (detector.columns, detector.rows, detector.center, detector.direction)
        )
        angles = torch.atan2(-columns[:, 0], columns[:, 1])
        pitch = float(columns[0].norm())
        across = torch.stack((-angles.sin(), angles.cos(), torch.zeros_like(angles)), 1)
        along = direction / direction.norm(dim=1, keepdim=True)
        middle = geometry.bounds.mean(0)
        wrong = (
            columns / pitch - across,
            rows / pitch + torch.tensor((0.0, 0.0, 1.0)),
            (along * across).sum(1),
            along[:, 2],
            ((center - middle) * across).sum(1) / pitch,
            (center - middle)[:, 2] / pitch,
            middle[:2] / pitch,
            (geometry.bounds[1] - geometry.bounds[0]) / pitch - detector.height,
        )
        if max(float(part.abs().max()) for part in wrong) > _EQUAL * detector.width:
            raise CaptureError(
                "Slices need square pixels as wide as the voxels, as many rows as a cube of N^3 voxels has slices, and "
                "an upright detector whose middle and the box's are on the axis; make such a geometry."
            )
        views, height, width = geometry.shape

        def sliced(values: torch.Tensor) -> np.ndarray:
            upwards = values[scan.train].reshape(views, height, width).flip(1)
            return np.ascontiguousarray(upwards.transpose(0, 1).float().numpy())

        return Slices(sliced(scan.measured / pitch), sliced(scan.weight), torch.rad2deg(angles).numpy(), pitch)

    @property
    def size(self) -> int:
        """N, voxels a side."""
        return int(self.sinograms.shape[0])

    @property
    def width(self) -> int:
        """W, pixels of a row."""
        return int(self.sinograms.shape[2])

    def volume(self, slices: np.ndarray) -> torch.Tensor:
        """Flat densities in the unit of the geometry, x fastest, of (N, M, M) slices whose axes are x and y.

        M is N or greater by an even number: what is around the middle N x N is cut off.
        """
        first = (slices.shape[1] - self.size) // 2
        cut = slices[:, first : first + self.size, first : first + self.size]
        return torch.from_numpy(np.ascontiguousarray(cut.transpose(0, 2, 1))).float().reshape(-1)

    def require_middle_pixel(self) -> None:
        """For packages that turn slices about pixel M // 2.

        Raises:
            CaptureError: That is not the middle, pixels do not count, or the slice's corners would be left out.
        """
        for count, things in ((self.width, "pixels in a row"), (self.size, "voxels a side")):
            if count % 2 == 0:
                raise CaptureError(
                    f"There are {count} {things}; scikit-image turns about pixel N // 2, which is the middle of odd "
                    "numbers only and half a pixel off that of even ones: project an odd volume on an odd detector."
                )
        if self.width // 2 - 1 < self.size / math.sqrt(2.0):
            least = 2 * math.ceil(self.size / math.sqrt(2.0)) + 3
            raise CaptureError(
                f"A row has {self.width} pixels, and scikit-image leaves out what is not in its circle; use a detector "
                f"of {least} columns or more, so that the circle holds the slice's corners."
            )
        if not bool((self.weights > 0).all()):
            raise CaptureError("Some pixels are not valid, and scikit-image's SART cannot leave any out; use MBIRJAX.")
