"""Truth beside several models: held-out views with PSNR, and cuts through the meshes."""

from __future__ import annotations

from dataclasses import dataclass

from PIL import Image, ImageOps

from difftetvr.capture.capture import Capture
from difftetvr.errors import CaptureError, counted
from difftetvr.fitting.records.evaluation import (
    BLACK,
    Color,
    Evaluation,
    evaluate,
    rendered_image,
    true_image,
    usual_background,
    valid_share,
)
from difftetvr.mesh.field import Field
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.view.cut import Plane, cut_picture
from difftetvr.view.pictures import below, beside, labelled, to_picture

_PANEL = 384  # least pixels of a panel's side


@dataclass(frozen=True)
class Model:
    """A reconstruction with a name to be shown."""

    name: str
    mesh: TetMesh
    field: Field


def compare_models(
    capture: Capture, models: list[Model], rows: int = 1, plane: Plane | None = None, background: Color | None = None
) -> Image.Image:
    """Draws truth | model | model ... for held-out views, labelled with the PSNR of this and of all views.

    Args:
        capture: Cameras and true images.
        models: What to show; at least one.
        rows: Views, evenly spread over those held out.
        plane: Adds a row of cuts along it through every model; the last one's is shown without cells, too. None: none.
        background: Behind the volume and beside the cuts; default: black, but white behind the views where they are
            photographs that alpha cuts out.

    Raises:
        CaptureError: The capture holds out no views with valid pixels, or rows is less than 1.
        MeshError: The plane misses a mesh.
    """
    tested = [view for view in capture.test_indices.tolist() if valid_share(capture, view) > 0.0]
    if not tested or rows < 1:
        held_out = counted(len(tested), "view")
        raise CaptureError(f"'{capture.name}' holds out {held_out}, of which to show {rows}; show at least 1.")
    count = min(rows, len(tested))
    behind_views = usual_background(capture) if background is None else background
    found = [evaluate(model.mesh, model.field, capture, tested, behind_views) for model in models]
    shown = [(2 * i + 1) * len(tested) // (2 * count) for i in range(count)]
    sheet = [_view_row(capture, models, found, row, behind_views) for row in shown]
    if plane is not None:
        sheet.append(_cut_row(models, plane, background or BLACK))
    return below(sheet)


def _view_row(
    capture: Capture, models: list[Model], found: list[Evaluation], row: int, background: Color
) -> Image.Image:
    """Truth and all models, for one of the views that were evaluated."""
    view = found[0].views[row]
    panels = [_panel(to_picture(true_image(capture, view, background)), f"truth, held-out view {view}")]
    for model, evaluation in zip(models, found, strict=True):
        image = rendered_image(model.mesh, model.field, capture, view, background)
        label = f"{model.name}, {evaluation.psnr[row]:.2f} dB (all views {evaluation.mean_psnr:.2f})"
        panels.append(_panel(to_picture(image), label))
    return beside(panels)


def _cut_row(models: list[Model], plane: Plane, background: Color) -> Image.Image:
    last = models[-1]
    behind = tuple(round(255 * min(max(value, 0.0), 1.0)) for value in background)

    def panel(model: Model, label: str, outlines: bool) -> Image.Image:
        picture = cut_picture(model.mesh, model.field, plane, _PANEL, outlines, background)
        return _panel(ImageOps.pad(picture, (_PANEL, _PANEL), color=behind), label)

    cells = [panel(m, f"cut, {m.name}, {counted(m.mesh.num_cells, 'cell')}", True) for m in models]
    return beside([panel(last, f"cut, {last.name}", False), *cells])


def _panel(picture: Image.Image, label: str) -> Image.Image:
    enlargement = max(1, -(-_PANEL // min(picture.size)))
    size = (picture.width * enlargement, picture.height * enlargement)
    return labelled(picture.resize(size, Image.Resampling.NEAREST), label)
