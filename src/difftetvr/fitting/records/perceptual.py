"""How alike images look to people: LPIPS (Zhang et al. 2018), by the packages and weights that papers compare with."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import torch

from difftetvr.capture.capture import Capture
from difftetvr.capture.truth import BLACK, Color, Truth
from difftetvr.errors import FitError
from difftetvr.fitting.records.evaluation import seen_and_true
from difftetvr.mesh.field import Field
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.rendering import ScalarField

Network = Literal["alex", "vgg"]
"""What LPIPS looks through: AlexNet, or VGG-16, as in most tables of radiance fields."""

_WEIGHTS = {"alex": "AlexNet_Weights", "vgg": "VGG16_Weights"}  # in torchvision
_LEAST_SIDE = {"alex": 31, "vgg": 16}  # pixels that are left of smaller ones by the last layer: none


def lpips_of(
    mesh: TetMesh,
    field: Field | ScalarField,
    capture: Capture,
    views: Sequence[int],
    network: Network,
    background: Color = BLACK,
) -> list[float]:
    """LPIPS of each view; 0 for images that are the same.

    Args:
        mesh: The reconstruction's mesh, on any device.
        field: What is on it.
        capture: Cameras and true images.
        views: Indices of the views to compare.
        network: What it looks through.
        background: Linear RGB behind the volume.

    Raises:
        FitError: A package or the weights are missing, or the images are too small.
    """
    require_lpips(network)
    smallest = min((min(camera.height, camera.width) for camera in capture.cameras), default=0)
    if smallest < _LEAST_SIDE[network]:
        raise FitError(
            f"LPIPS by {network} needs images of at least {_LEAST_SIDE[network]} pixels a side, and '{capture.name}' "
            f"has some of {smallest}; leave it out."
        )
    truth, measure = Truth(capture, mesh.vertices.device), _measure(network)
    found = []
    for view in views:
        images = seen_and_true(mesh, field, truth, view, background)
        first, second = (image.detach().cpu().clamp(0.0, 1.0).permute(2, 0, 1)[None] for image in images)
        found.append(float(measure(first, second)))
    return found


def require_lpips(network: Network) -> None:
    """Checks that what LPIPS needs is there, before anything else is done: nothing is fetched.

    Raises:
        FitError: A package or the weights are missing, or torchvision does not run.
    """
    has_lpips, has_metrics, has_vision = (
        importlib.util.find_spec(name) is not None for name in ("lpips", "torchmetrics", "torchvision")
    )
    if not (has_lpips or has_metrics) or not has_vision:
        raise FitError(
            "LPIPS is computed by the package lpips, or torchmetrics, through networks of torchvision, and not all of "
            "that is installed; pip install 'difftetvr[lpips]'."
        )
    try:
        import torchvision
    except (ImportError, RuntimeError) as error:  # the latter where it was built for another PyTorch
        raise FitError(
            f"torchvision does not run beside PyTorch {torch.__version__} ({error}); install the one made for it."
        ) from error
    address = getattr(torchvision.models, _WEIGHTS[network]).IMAGENET1K_V1.url
    folder = Path(torch.hub.get_dir()) / "checkpoints"
    weights = folder / address.rpartition("/")[2]
    if not weights.is_file():
        raise FitError(f"LPIPS by {network} needs the weights {weights.name} in {folder}; put {address} there.")


def _measure(network: Network) -> Callable[[torch.Tensor, torch.Tensor], Any]:
    """Takes two (1, 3, H, W) images in [0, 1]."""
    if importlib.util.find_spec("lpips") is not None:
        import lpips

        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")  # of torchvision, about how lpips calls it
            model = lpips.LPIPS(net=network, verbose=False)
        return torch.no_grad()(lambda image, truth: model(image, truth, normalize=True))
    from torchmetrics.functional.image import learned_perceptual_image_patch_similarity as measure

    return torch.no_grad()(lambda image, truth: measure(image, truth, net_type=network, normalize=True))
