"""The commands that look at files: ``difftetvr eval | info``."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import tyro
from tyro.conf import OmitArgPrefixes, Positional, arg

from difftetvr.capture.projections.naming import is_projection_source
from difftetvr.cli.arguments import Groups
from difftetvr.cli.options import (
    CAPTURE_GROUPS,
    CaptureOptions,
    Color,
    MeshOptions,
    TrustOptions,
    color_of,
    load_model,
    saying,
)
from difftetvr.cli.parsing import parse_if_valid
from difftetvr.cli.saved import is_of_scan, run_behind
from difftetvr.errors import FitError
from difftetvr.files import require_writable
from difftetvr.fitting.records.folder import RunFolder, write_json

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from difftetvr.capture.projections.projection_capture import ProjectionCapture


@dataclass(frozen=True)
class Eval:
    """Compare a reconstructed volume with the held-out views of a capture."""

    model: Annotated[Path, Positional, arg(metavar="MODEL")]
    """Mesh with color and density."""
    capture: Annotated[str | None, Positional, arg(metavar="CAPTURE")] = None
    """What it was fitted to: tooth, or the path of a volume, of photographs or of a saved capture (.npz). May be left
    out beside the config.json of the model's run, whose options are then those that are not given here."""
    output: Annotated[Path | None, arg(aliases=["-o"])] = None
    """File to write the numbers to, JSON."""
    all_views: bool = False
    """Compare with the training views, too."""
    lpips: Literal["alex", "vgg"] | None = None
    """Tell LPIPS, too, through this network (extra `lpips`)."""
    background: Color | None = None
    """Behind the volume: black, white or R G B; default: that of the run, else white for photographs that alpha cuts
    out, black for all others."""
    device: str | None = None
    """Where to render."""
    views_of: OmitArgPrefixes[CaptureOptions] = field(default_factory=CaptureOptions)
    trust: OmitArgPrefixes[TrustOptions] = field(default_factory=TrustOptions)
    groups: ClassVar[Groups] = CAPTURE_GROUPS

    def run(self, console: Console) -> None:
        """Renders the views and prints PSNR and SSIM of each."""
        from difftetvr.fitting.records.evaluation import evaluate, usual_background
        from difftetvr.fitting.records.perceptual import lpips_of, require_lpips
        from difftetvr.view.describe import evaluation_table

        if self.capture is None:
            if is_of_scan(RunFolder(self.model.parent)):
                raise FitError(
                    f"{self.model} was reconstructed from projections, and eval compares images; metrics.json beside "
                    "it tells its held-out views."
                )
            raise FitError(f"No config.json of a run lies beside {self.model} and says what it fits; name CAPTURE.")
        if self.output is not None:
            require_writable(self.output, FitError)
        if self.lpips is not None:
            require_lpips(self.lpips)
        given = None if self.background is None else color_of(self.background)
        mesh, field_on_mesh = load_model(self.model, self.device, console=console)
        views_of = self.views_of.sized_for(self.capture, self.device, console)
        console.print(f"Comparing with: {shlex.join([self.capture, *views_of.in_words()])}", highlight=False)
        capture = views_of.load(self.capture, console)
        background = usual_background(capture) if given is None else given
        views = list(range(len(capture.cameras))) if self.all_views else capture.test_indices.tolist()
        if not views:
            raise FitError(f"'{capture.name}' holds out no views; compare with all of them with --all-views.")
        evaluation = evaluate(mesh, field_on_mesh, capture, views, background)
        numbers, lpips = evaluation.to_json(), None
        if self.lpips is not None:
            lpips = lpips_of(mesh, field_on_mesh, capture, evaluation.views, self.lpips, background)
            mean = sum(lpips) / len(lpips) if lpips else None
            numbers |= {"lpips": mean, "lpips_per_view": lpips, "lpips_network": self.lpips}
        console.print(evaluation_table(evaluation, lpips))
        if self.output is not None:
            write_json(self.output, numbers)

    @staticmethod
    def defaults(args: Sequence[str]) -> Eval | None:
        """The command as the run beside the model would be evaluated; None: as declared."""
        model: Any = tyro.MISSING
        given = parse_if_valid(Eval, "eval", args, Eval(model))
        run = None if given is None else run_behind(given.model, given.capture)
        if run is None:
            return None
        return Eval(model, run.capture, background=run.fit.evaluation_background(), views_of=run.capture_options)


@dataclass(frozen=True)
class Info:
    """Describe a mesh, a volume, a capture or projections."""

    file: Annotated[str, Positional, arg(metavar="FILE")]
    """A mesh (.vtu, .vtk, .msh, .mesh, .xdmf, .npz, .bintet, .ovm, .node), a volume, a capture (.npz), projections
    (.h5, .npz or a folder), or tooth.
    A volume's values are described without a --transfer-function, its views with one."""
    reading: OmitArgPrefixes[MeshOptions] = field(default_factory=MeshOptions)
    views_of: OmitArgPrefixes[CaptureOptions] = field(default_factory=CaptureOptions)
    trust: OmitArgPrefixes[TrustOptions] = field(default_factory=TrustOptions)
    groups: ClassVar[Groups] = CAPTURE_GROUPS

    def run(self, console: Console) -> None:
        """Prints tables."""
        from difftetvr.capture.volumes.volume import is_volume_file
        from difftetvr.view.describe import capture_table, data_table, mesh_tables, scan_table, volume_table

        path = Path(self.file)
        if is_projection_source(self.file):
            with saying(console):
                console.print(scan_table(self.file, _projections(self.file)))
            return
        if is_volume_file(path) and self.views_of.transfer_function is None:
            console.print(volume_table(self.file, self.views_of.summarise(self.file, console)))
            return
        if _is_capture(path):
            console.print(capture_table(self.file, self.views_of.load(self.file, console)))
            return
        from difftetvr.mesh.io import FIELD_ARRAYS, HARMONICS

        data = self.reading.load(path, console)
        for table in mesh_tables(self.file, data.mesh, data.field, data.defects):
            console.print(table)
        shown = (*FIELD_ARRAYS, HARMONICS) if data.field is not None else ()
        others = [{n: v for n, v in d.items() if n not in shown} for d in (data.point_data, data.cell_data)]
        if (table_of_data := data_table(*others)) is not None:
            console.print(table_of_data)
        if (table_of_run := _run_of(path)) is not None:
            console.print(table_of_run)


def _projections(source: str) -> ProjectionCapture:
    from difftetvr.capture.projections.projection_capture import ProjectionCapture

    return ProjectionCapture.load(source)


def _run_of(path: Path) -> Table | None:
    """What is known of the run that a model is the result of; None where it lies beside none."""
    from difftetvr.view.describe import run_table

    folder = RunFolder(path.parent)
    if path.name != folder.model.name or not (folder.config.is_file() and folder.metrics.is_file()):
        return None
    try:
        config, metrics = (json.loads(file.read_text(encoding="utf-8")) for file in (folder.config, folder.metrics))
    except (OSError, ValueError, RecursionError):
        return None
    return run_table("run", config, metrics) if isinstance(config, dict) and isinstance(metrics, dict) else None


def _is_capture(path: Path) -> bool:
    from difftetvr.capture.photos.photo_capture import is_photo_source
    from difftetvr.capture.volumes.volume import is_volume_file
    from difftetvr.capture.volumes.volume_capture import TOOTH
    from difftetvr.mesh.io import is_mesh_archive

    is_saved_capture = path.suffix.lower() == ".npz" and path.is_file() and not is_mesh_archive(path)
    return is_photo_source(path) or str(path) == TOOTH or is_volume_file(path) or is_saved_capture
