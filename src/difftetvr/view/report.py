"""The output folder of a finished reconstruction: model, numbers, curves and pictures."""

from __future__ import annotations

import dataclasses
from typing import Any

from difftetvr.capture.capture import Capture
from difftetvr.errors import CaptureError
from difftetvr.fitting.records.evaluation import Color, rendered_image, true_image, valid_share, where_valid
from difftetvr.fitting.records.folder import RunFolder, write_json
from difftetvr.fitting.records.result import FitResult
from difftetvr.mesh.field import Field
from difftetvr.mesh.io import save
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.rendering import ScalarField
from difftetvr.view.cut import cut_picture
from difftetvr.view.pictures import save_comparisons, save_picture, save_png
from difftetvr.view.plots import save_curves

_COMPARED_VIEWS = 4
_SINGLE_VIEWS = 16


def write_report(folder: RunFolder, result: FitResult, capture: Capture) -> None:
    """Writes everything that a run leaves behind; the metrics come last, so they stand for a complete folder.

    Pictures show held-out views, or training views of a capture that holds none out.

    Args:
        folder: Existing folder.
        result: The finished reconstruction.
        capture: The images that it was made from.

    Raises:
        MeshError: The model cannot be written.
        CaptureError: A picture cannot be written.
        FitError: The curves or the metrics cannot be written.
    """
    if result.refined is not None:
        capture = dataclasses.replace(capture, cameras=result.refined.cameras())
        write_json(folder.cameras, _cameras_of(capture))
    save(folder.model, result.mesh, result.field)
    save_curves(folder.curves, result.history)
    write_views(folder, result.mesh, result.field, capture, result.config.evaluation_background())
    save_picture(folder.cut, cut_picture(result.mesh, result.field))
    write_json(folder.metrics, {"capture": capture.name, **result.metrics})


def write_views(
    folder: RunFolder, mesh: TetMesh, field: Field | ScalarField, capture: Capture, background: Color
) -> None:
    """Writes pictures of some views, single ones and beside each other.

    Args:
        folder: Existing folder.
        mesh: The mesh.
        field: What it holds.
        capture: The true images.
        background: Behind the volume.

    Raises:
        CaptureError: A picture cannot be written.
    """
    views = _spread(capture.test_indices.tolist() or capture.train_indices.tolist(), _SINGLE_VIEWS)
    compared = _spread(views, _COMPARED_VIEWS)
    rows = []
    try:
        folder.views.mkdir(exist_ok=True)
    except OSError as error:
        raise CaptureError(f"The folder {folder.views} cannot be created ({error.strerror}); free it.") from error
    for view in views:
        truth = true_image(capture, view, background)
        image = rendered_image(mesh, field, capture, view, background)
        save_png(folder.views / f"{view:04d}_truth.png", truth)
        save_png(folder.views / f"{view:04d}_reconstruction.png", image)
        if view in compared:
            shown = where_valid(capture, view, image, truth)
            rows.append((f"truth, view {view}", truth, shown, valid_share(capture, view)))
    save_comparisons(folder.comparison, rows)


def _cameras_of(capture: Capture) -> dict[str, Any]:
    """All cameras as JSON values, each as `difftetvr.rendering.save_camera` writes it."""
    cameras = []
    for view, camera in enumerate(capture.cameras):
        numbers = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
        pose = camera.world_to_camera.double().cpu().tolist()
        is_test = bool(capture.test[view])
        cameras.append({"view": view, "test": is_test, "world_to_camera": pose, **numbers})
    return {"format": "difftetvr-refined-cameras", "cameras": cameras}


def _spread(views: list[int], count: int) -> list[int]:
    """At most ``count`` of the views, evenly spread."""
    if len(views) <= count:
        return views
    return [views[i * len(views) // count] for i in range(count)]
