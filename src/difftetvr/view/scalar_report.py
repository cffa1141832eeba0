"""The output folder of a finished reconstruction of scalars: model, transfer function, numbers, curves and pictures."""

from __future__ import annotations

import torch

from difftetvr.capture.capture import Capture
from difftetvr.capture.truth import BLACK
from difftetvr.fitting.records.folder import RunFolder, write_json
from difftetvr.inverse.scalars.loop import ScalarResult
from difftetvr.mesh.field import Field
from difftetvr.mesh.io import save
from difftetvr.view.cut import cut_picture
from difftetvr.view.pictures import save_picture
from difftetvr.view.plots import save_curves
from difftetvr.view.report import write_views

_SOLID = 1e6  # density at which a slab of any thickness shows the colours themselves


def write_scalar_report(folder: RunFolder, result: ScalarResult, capture: Capture) -> None:
    """Writes everything that a run leaves behind; the metrics come last, so they stand for a complete folder.

    Args:
        folder: Existing folder.
        result: The finished reconstruction.
        capture: The images that it was made from.

    Raises:
        MeshError: The model cannot be written.
        CaptureError: A picture cannot be written.
        FitError: The function, the curves or the metrics cannot be written.
    """
    save(folder.model, result.mesh, point_data={"scalar": result.field.scalar})
    result.transfer_function.save(folder.transfer_function)
    save_curves(folder.curves, result.history)
    write_views(folder, result.mesh, result.field, capture, BLACK)
    grey = result.field.scalar[:, None].expand(-1, 3).contiguous()
    save_picture(folder.cut, cut_picture(result.mesh, Field(grey, torch.full_like(result.field.scalar, _SOLID))))
    write_json(folder.metrics, {"capture": capture.name, **result.metrics})
