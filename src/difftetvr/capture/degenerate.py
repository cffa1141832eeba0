"""Captures from which nothing can be reconstructed, and why: a PSNR of such a fit would say nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from difftetvr.capture.viewing import positions_of

if TYPE_CHECKING:
    from difftetvr.capture.capture import Capture

_STEP = 1.0 / 255.0
_ONE_PLACE = 1e-6  # of the distance of the scene


def why_degenerate(capture: Capture) -> str | None:
    """Why a capture's training views say nothing about the shape of a scene, and what to do: a sentence; else None.

    Args:
        capture: Images and cameras. Rarely more than one image is looked at.
    """
    name, views = capture.name, capture.train_indices.tolist()
    if len(views) == 1:
        return (
            f"'{name}' has one view to train on, which says nothing about depth; give two at least, or hold out none "
            "(test_every 0)."
        )
    if _are_at_one_place(capture, views):
        return (
            f"All training views of '{name}' are taken from one place, which says nothing about depth; check the poses."
        )
    if capture.valid is not None and not any(bool(capture.valid[view].any()) for view in views):
        return (
            f"The masks of '{name}' exclude all pixels of all training views; check that what they keep is not black."
        )
    if all(_is_blank(capture, view) for view in views):
        color = ", ".join(f"{channel:.3g}" for channel in capture.images[views[0]][0, 0].tolist())
        what = "the images" if capture.encoding == "srgb" else "the transfer function and the range of the values"
        return (
            f"Every training view of '{name}' shows one colour only, such as ({color}), so there is nothing to "
            f"reconstruct; check {what}."
        )
    return None


def _are_at_one_place(capture: Capture, views: list[int]) -> bool:
    positions = positions_of([capture.cameras[view] for view in views])
    middle = capture.bounds.double().mean(dim=0).numpy()
    apart = np.linalg.norm(positions - positions[0], axis=1).max()
    return bool(apart <= _ONE_PLACE * np.linalg.norm(positions[0] - middle))


def _is_blank(capture: Capture, view: int) -> bool:
    """Whether the valid pixels of a view are alike: those of photographs up to rounding."""
    tolerance = _STEP if capture.encoding == "srgb" else 0.0
    layers = [capture.images[view]]
    if capture.alphas is not None:
        layers.append(capture.alphas[view][..., None])
    for values in layers:
        counted = values.flatten(0, 1) if capture.valid is None else values[capture.valid[view]]
        if len(counted) and float((counted.amax(0) - counted.amin(0)).max()) > tolerance + 1e-6 * tolerance:
            return False
    return True
