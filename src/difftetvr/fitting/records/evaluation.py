"""How well a reconstruction shows views: images, PSNR and SSIM."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch

from difftetvr.capture.capture import Capture
from difftetvr.capture.truth import BLACK, WHITE, Color, Truth
from difftetvr.fitting.metrics import SSIM_WINDOW, psnr, ssim
from difftetvr.mesh.field import Field
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.rendering import ScalarField, render


@dataclass(frozen=True)
class Evaluation:
    """Image quality per view.

    Attributes:
        views: Indices of the views in the capture.
        psnr: PSNR in dB of each.
        ssim: SSIM of each, in which masked pixels are right; empty where it was not asked for, or the images are
            smaller than its window of 11 x 11 pixels.
    """

    views: list[int]
    psnr: list[float]
    ssim: list[float]

    @staticmethod
    def of_rows(rows: list[list[float]]) -> Evaluation:
        """What evaluations of one view each, as their :attr:`row`, say together."""
        seen = [row for row in rows if not math.isnan(row[0])]
        ssims = [row[2] for row in seen if not math.isnan(row[2])]
        return Evaluation([int(row[0]) for row in seen], [row[1] for row in seen], ssims)

    @property
    def row(self) -> list[float]:
        """View, PSNR and SSIM of the only view, NaN for what is not known: numbers that processes can exchange."""
        view: list[float] = [float(self.views[0]), *self.psnr] if self.views else [math.nan, math.nan]
        return view + (self.ssim or [math.nan])

    @property
    def mean_psnr(self) -> float | None:
        """Mean over the views of the PSNR in dB; None without views."""
        return sum(self.psnr) / len(self.psnr) if self.psnr else None

    @property
    def mean_ssim(self) -> float | None:
        """Mean over the views of the SSIM; None without values."""
        return sum(self.ssim) / len(self.ssim) if self.ssim else None

    def to_json(self) -> dict[str, Any]:
        """Means as ``psnr`` and ``ssim``, and the values of each of ``views``."""
        return {
            "psnr": self.mean_psnr,
            "ssim": self.mean_ssim,
            "views": self.views,
            "psnr_per_view": self.psnr,
            "ssim_per_view": self.ssim,
        }


def usual_background(capture: Capture) -> Color:
    """What held-out views are compared over by default: white for photographs that alpha cuts out, else black."""
    return WHITE if capture.encoding == "srgb" and capture.is_cut_out else BLACK


def true_image(capture: Capture, view: int, background: Color = BLACK) -> torch.Tensor:
    """(H, W, 3) image of a view over a background, on the CPU.

    Raises:
        CaptureError: The background is not black and the capture knows no alpha.
    """
    return _on_host(capture).image(view, background)


def where_valid(capture: Capture, view: int, image: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """An image of a view with the truth in the pixels that the capture's mask leaves out, on the CPU."""
    return _on_host(capture).where_valid(view, image, truth)


def valid_share(capture: Capture, view: int) -> float:
    """Share of a view's pixels that the capture's mask does not leave out."""
    return _on_host(capture).share(view)


def rendered_image(
    mesh: TetMesh, field: Field | ScalarField, capture: Capture, view: int, background: Color = BLACK
) -> torch.Tensor:
    """(H, W, 3) image of the reconstruction from the camera of a view, on the CPU."""
    return _rendered(mesh, field, _on_host(capture), view, background).cpu()


def evaluate(
    mesh: TetMesh, field: Field | ScalarField, capture: Capture, views: Sequence[int], background: Color = BLACK
) -> Evaluation:
    """Renders views and compares them with the truth, where the mesh is.

    Args:
        mesh: The reconstruction's mesh, on any device.
        field: Its colours and densities, or scalars.
        capture: Cameras and true images.
        views: Indices of the views to compare; those without any valid pixel are left out.
        background: Linear RGB behind the volume.
    """
    return compared(mesh, field, Truth(capture, mesh.vertices.device), views, background)


def compared(
    mesh: TetMesh,
    field: Field | ScalarField,
    truth: Truth,
    views: Sequence[int],
    background: Color = BLACK,
    similarity: bool = True,
) -> Evaluation:
    """What :func:`evaluate` returns, of a capture whose views are known already; SSIM, which costs most, if wanted."""
    psnrs, ssims = [], []
    views = [view for view in views if truth.share(view) > 0.0]
    for view in views:
        image, expected = seen_and_true(mesh, field, truth, view, background)
        psnrs.append(psnr(image, expected, truth.share(view)))
        if similarity and min(expected.shape[:2]) >= SSIM_WINDOW:
            ssims.append(ssim(image, expected))
    return Evaluation(views, psnrs, ssims)


def seen_and_true(
    mesh: TetMesh, field: Field | ScalarField, truth: Truth, view: int, background: Color = BLACK
) -> tuple[torch.Tensor, torch.Tensor]:
    """(H, W, 3) image of the reconstruction and of the capture, the same in pixels that do not count."""
    expected = truth.image(view, background)
    image = _rendered(mesh, field, truth, view, background).to(truth.device)
    return truth.where_valid(view, image, expected), expected


@torch.no_grad()
def _rendered(mesh: TetMesh, field: Field | ScalarField, truth: Truth, view: int, background: Color) -> torch.Tensor:
    return render(mesh, field, truth.camera(view), background=torch.tensor(background)).color


def _on_host(capture: Capture) -> Truth:
    return Truth(capture, torch.device("cpu"))
