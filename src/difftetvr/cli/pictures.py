"""The commands that draw models beside each other or cut open: ``difftetvr compare | cut``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import tyro
from tyro.conf import OmitArgPrefixes, Positional, arg

from difftetvr.cli.arguments import Groups
from difftetvr.cli.drawing.cameras import CameraOptions, Place
from difftetvr.cli.drawing.scalars import COLOR_GROUP, ColorOptions
from difftetvr.cli.options import (
    CAPTURE_GROUPS,
    TRUST_GROUPS,
    CaptureOptions,
    Color,
    MeshOptions,
    Output,
    TrustOptions,
    color_of,
    load_model,
)
from difftetvr.cli.parsing import parse_if_valid
from difftetvr.cli.saved import run_behind
from difftetvr.errors import CaptureError, counted
from difftetvr.files import require_writable

if TYPE_CHECKING:
    from rich.console import Console

_MOST_PIXELS = 16384  # of a cut's side


@dataclass(frozen=True)
class Compare:
    """Draw held-out views of a capture beside those of models, with PSNR, and a cut through each model."""

    capture: Annotated[str, Positional, arg(metavar="CAPTURE")]
    """What they were fitted to: tooth, or the path of a volume, of photographs or of a saved capture (.npz). Options of
    how it is read that are not given are those of the models' runs, where these agree."""
    models: Annotated[tuple[Path, ...], Positional, arg(metavar="MODEL")]
    """Meshes with color and density."""
    output: Output
    """The picture, .png."""
    names: tuple[str, ...] = ()
    """Names of the models; default: those of their files."""
    rows: int = 1
    """Views to show."""
    normal: tuple[float, float, float] = (1.0, 0.0, 0.0)
    """Direction in which the cut is looked at."""
    no_cut: bool = False
    """Leave the cuts out."""
    background: Color | None = None
    """Behind the volume and the cuts: black, white or R G B; default: black, but white behind the views where they are
    photographs that alpha cuts out."""
    device: str | None = None
    """Where to render."""
    views_of: OmitArgPrefixes[CaptureOptions] = field(default_factory=CaptureOptions)
    trust: OmitArgPrefixes[TrustOptions] = field(default_factory=TrustOptions)
    groups: ClassVar[Groups] = CAPTURE_GROUPS

    def run(self, console: Console) -> None:
        """Renders and writes the picture."""
        from difftetvr.view.compare import Model, compare_models
        from difftetvr.view.cut import Plane
        from difftetvr.view.pictures import require_png, save_picture

        require_png(self.output)
        require_writable(self.output, CaptureError)
        background = None if self.background is None else color_of(self.background)
        if not self.models:
            raise CaptureError("There is no model to compare with; name one or more after the capture.")
        if self.names and len(self.names) != len(self.models):
            count = counted(len(self.models), "model")
            raise CaptureError(f"The picture is to show {count} but {len(self.names)} --names; give one for each.")
        names = self.names or tuple(path.stem for path in self.models)
        models = [
            Model(name, *load_model(path, self.device, console=console))
            for name, path in zip(names, self.models, strict=True)
        ]
        capture = self.views_of.sized_for(self.capture, self.device, console).load(self.capture, console)
        plane = None if self.no_cut else Plane(self.normal)
        save_picture(self.output, compare_models(capture, models, self.rows, plane, background))
        console.print(f"Wrote {self.output}")

    @staticmethod
    def defaults(args: Sequence[str]) -> Compare | None:
        """The command with the views as the runs beside the models have them; None: as declared, or they differ."""
        absent: Any = tyro.MISSING
        given = parse_if_valid(Compare, "compare", args, Compare(absent, absent, absent))
        found = () if given is None else (run_behind(model, given.capture) for model in given.models)
        ways = {run.capture_options for run in found if run is not None}
        return Compare(absent, absent, absent, views_of=ways.pop()) if len(ways) == 1 else None


@dataclass(frozen=True)
class Cut:
    """Draw a cut through a mesh: its colours, or a scalar, and its cells."""

    model: Annotated[Path, Positional, arg(metavar="MODEL")]
    """Mesh with color and density, or with scalars. Of what was fitted to photographs, the part that these look at is
    drawn, and not all of its surroundings."""
    output: Output
    """The picture, .png."""
    normal: tuple[float, float, float] = (1.0, 0.0, 0.0)
    """Direction in which the cut is looked at."""
    origin: tuple[float, float, float] | None = None
    """A point of the cut; default: the centre of the mesh, or of what photographs look at."""
    size: int = 1024
    """Pixels of the longer side."""
    no_cells: bool = False
    """Leave the outlines of the cells out."""
    background: Color = "black"
    """Behind what is cut: black, white or R G B."""
    colorbar: bool = False
    """Which colour the scalar has where, beside the cut."""
    scalars: OmitArgPrefixes[ColorOptions] = field(default_factory=ColorOptions)
    mesh: OmitArgPrefixes[MeshOptions] = field(default_factory=MeshOptions)
    trust: OmitArgPrefixes[TrustOptions] = field(default_factory=TrustOptions)
    groups: ClassVar[Groups] = {
        "Cut": ("normal", "origin", "size", "no-cells", "background", "colorbar"),
        "Scalars of a simulation": COLOR_GROUP,
        "How MODEL is read": ("split", "step"),
        **TRUST_GROUPS,
    }

    def run(self, console: Console) -> None:
        """Draws and writes the picture."""
        from difftetvr.view.cut import Plane, cut_picture
        from difftetvr.view.frames.color_bar import beside_color_bar
        from difftetvr.view.pictures import require_png, save_picture

        require_png(self.output)
        require_writable(self.output, CaptureError)
        if not 2 <= self.size <= _MOST_PIXELS:
            raise CaptureError(f"--size is {self.size}; it must lie between 2 and {_MOST_PIXELS}.")
        background, place = color_of(self.background), Place(self.model, CameraOptions(), console)
        shown = self.scalars.apply(self.mesh.load(self.model, console), self.model)
        if self.colorbar and shown.scale is None:
            raise CaptureError(f"{self.model} shows its own colours, not a scalar's; leave out --colorbar.")
        if shown.note is not None:
            console.print(shown.note)
        views = place.views
        origin = self.origin if views is None or self.origin is not None else tuple(views.focus.tolist())
        within = None if views is None else views.inner_bounds
        plane = Plane(self.normal, origin)
        picture = cut_picture(shown.mesh, shown.field, plane, self.size, not self.no_cells, background, within)
        if self.colorbar and shown.scale is not None:
            picture = beside_color_bar(picture, shown.scale, background)
        save_picture(self.output, picture)
        console.print(f"Wrote {self.output} ({picture.width} x {picture.height})")
