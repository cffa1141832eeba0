"""What a reconstruction needs: images that allow what the options ask for, and a device that can do it."""

from __future__ import annotations

import torch

from difftetvr.backend import default_device, devices_here, get_backend
from difftetvr.capture.capture import Capture
from difftetvr.capture.degenerate import why_degenerate
from difftetvr.errors import CaptureError, FitError, counted, shown
from difftetvr.fitting.config import FitConfig
from difftetvr.fitting.metrics import SSIM_WINDOW
from difftetvr.fitting.refinement import Strategy
from difftetvr.trust import require_free

_WITHOUT_DOUBLES = ("mps",)
# What the peak memory of runs of the tooth with 100 000 to 800 000 cells grows by, rounded down: few views, so that
# images and kernels count little.
_BYTES_PER_CELL, _BYTES_PER_REFINED_CELL = 350, 1500


def require_fittable(capture: Capture, config: FitConfig, strategy: Strategy | None) -> None:
    """Checks what can be known before the first iteration.

    Raises:
        CaptureError: The images have no alpha but the background needs it, are too small for the loss, or say nothing
            about the shape of a scene.
        FitError: The device does not exist or cannot move vertices, or a strategy would refine a field on cells.
        BackendError: No back end works, or the device has none.
    """
    if strategy is not None and config.location == "cell":
        raise FitError("A field on cells cannot be refined; put it on vertices (location vertex), or do not refine.")
    if (reason := why_degenerate(capture)) is not None:
        raise CaptureError(reason)
    width, height = min(capture.image_sizes, key=min)
    if config.loss == "l1-ssim" and min(height, width) < SSIM_WINDOW:
        raise CaptureError(
            f"The images of '{capture.name}' have {width} x {height} pixels, fewer than the {SSIM_WINDOW} that SSIM "
            "compares at a time; use the loss l2 or l1."
        )
    if config.needs_alpha and capture.alphas is None:
        raise CaptureError(
            f"The images of '{capture.name}' have no alpha, which the background {config.background} needs; "
            "use background black."
        )
    device = device_for(config, strategy)
    if device.type in _WITHOUT_DOUBLES and _changes_meshes(config, strategy):
        raise FitError(
            f"Vertices move and meshes change in double precision, which {device.type} lacks; use the device cpu, or "
            "neither move nor refine (--no-move --refine none)."
        )


def require_memory_for(cells: int, config: FitConfig, strategy: Strategy | None) -> None:
    """Checks that a run with so many cells fits the memory of its device, as far as that can be said beforehand.

    Raises:
        FitError: It does not.
    """
    device = device_for(config, strategy)
    require_free(
        cells * (_BYTES_PER_CELL if strategy is None else _BYTES_PER_REFINED_CELL),
        f"A run with {counted(cells, 'cell')}",
        "give fewer with --cells or --grid",
        FitError,
        torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else None,
    )


def _changes_meshes(config: FitConfig, strategy: Strategy | None) -> bool:
    return config.move or strategy is not None


def device_for(config: FitConfig, strategy: Strategy | None) -> torch.device:
    """The device that the options name; by default the best one that can do what they ask for."""
    device = resolve_device(config.device)
    if config.device is None and device.type in _WITHOUT_DOUBLES and _changes_meshes(config, strategy):
        return resolve_device("cpu")
    return device


def resolve_device(name: str | None) -> torch.device:
    """The device of that name, the best that works for None.

    Raises:
        FitError: There is no such device here.
        BackendError: It has no back end, or its back end does not work.
    """
    if name is None:
        return default_device()
    try:
        device = torch.device(name)
        if device.type == "cpu" and device.index:
            raise ValueError  # there is one, but torch takes any number
        torch.empty(1, device=device)
    except Exception as error:  # of any class, and up to kilobytes, for a device that this PyTorch was not built for
        raise FitError(f"The device {shown(name)} cannot be used on this machine; use {devices_here()}.") from error
    get_backend(name)
    return device
