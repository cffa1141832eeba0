"""How well a density predicts projections."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch

from difftetvr.fitting.metrics import psnr_of_mse
from difftetvr.inverse.tomography.measurements import PixelSet
from difftetvr.mesh.field import Field
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.rendering import render


@dataclass(frozen=True)
class ProjectionScore:
    """Agreement with the measured line integrals of some views.

    Attributes:
        views: Their numbers.
        psnr: PSNR in dB of each, with the scan's greatest line integral as peak.
        noise: Root of the mean squared residual of each, in units of the noise that is expected: 1 where nothing but
            noise is left.
    """

    views: list[int]
    psnr: list[float]
    noise: list[float]

    @property
    def mean_psnr(self) -> float:
        """Mean of the PSNR over the views, in dB; NaN without views."""
        return sum(self.psnr) / len(self.psnr) if self.psnr else float("nan")

    @property
    def mean_noise(self) -> float:
        """Mean of the residuals in units of the noise; NaN without views."""
        return sum(self.noise) / len(self.noise) if self.noise else float("nan")

    def to_json(self) -> dict[str, Any]:
        """Means and values of each view; None for means of no views."""
        means = (self.mean_psnr, self.mean_noise) if self.views else (None, None)
        return {
            "projection_psnr": means[0],
            "residual_in_noise": means[1],
            "views": self.views,
            "psnr_per_view": self.psnr,
            "residual_per_view": self.noise,
        }


@torch.no_grad()
def score_views(
    mesh: TetMesh, density: torch.Tensor, peak: float, parts: Sequence[tuple[int, PixelSet]]
) -> ProjectionScore:
    """Compares views with what is predicted of them; those without a valid pixel are left out.

    Args:
        mesh: The mesh.
        density: (V,) densities per unit of length.
        peak: Greatest line integral of the scan.
        parts: Numbers of views, and what was measured of each.
    """
    seen, psnrs, noises = [], [], []
    field = Field(density.new_zeros(len(density), 0), density, "vertex")
    for view, part in parts:
        counts = part.weight > 0
        if not bool(counts.any()):
            continue
        squares = (render(mesh, field, part.camera).optical_depth - part.measured)[counts].double().square()
        seen.append(view)
        psnrs.append(psnr_of_mse(float(squares.mean()) / peak**2))
        noises.append(float((squares * part.weight[counts]).mean().sqrt()))
    return ProjectionScore(seen, psnrs, noises)
