"""Pages that show a volume in a browser: what of it, and how they open."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from difftetvr.cli.export.job import Job
from difftetvr.cli.options import Color, color_of
from difftetvr.cli.render import ScalarOptions, Shown
from difftetvr.errors import MeshError, counted
from difftetvr.terminal import waiting

_USUAL = ScalarOptions()
_RESULT = "model"  # what the mesh of a run is called, whose folder says more


@dataclass(frozen=True)
class PageOptions:
    """What a page shows, and how it opens."""

    transfer_function: Path | None = _USUAL.transfer_function
    """Colour and opacity of the scalar, .json or .xml; default: the look that render
    chooses."""
    value_range: tuple[float, float] | None = _USUAL.value_range
    """Scalars at the transfer function's 0 and 1; default: the least and the greatest, but
    for outliers."""
    attenuation: float | None = _USUAL.attenuation
    """Density of opacity 1, where the mesh's longest side is 1; default: 25 with a transfer function, else chosen."""
    background: Color = "black"
    """Behind the volume: black, white or linear R G B."""
    camera: Path | None = None
    """File of the camera, .json, whose view the page opens with; default: the whole mesh."""
    title: str | None = None
    """What the page is called; default: the name of MODEL, or of its folder."""

    def write(self, job: Job) -> None:
        """Quantises and writes.

        Raises:
            MeshError: The mesh or its data cannot be shown in a page.
        """
        from difftetvr.rendering.cameras.camera_file import load_camera
        from difftetvr.view import page as pages

        background = color_of(self.background)
        camera = None if self.camera is None else load_camera(self.camera)
        shown = self._shown(job)
        options = pages.PageOptions(self._title(job.model), background, camera, shown.name)
        with job.naming_model(), waiting(job.console, f"Writing {job.output}"):
            page = pages.save_page(job.output, shown.mesh, shown.field, options)
        if shown.note is not None:
            job.say(shown.note)
        if job.data.defects.doubled_places > 0:
            job.say("Some cells of this mesh overlap; the page draws them one behind the other, which render does not.")
        if page.inverted:
            verb = "is" if page.inverted == 1 else "are"
            cells = counted(page.inverted, "cell")
            job.say(f"{cells} {verb} so flat that a page's numbers turn them inside out; rays pass there unchanged.")
        what = "" if shown.name is None else f", {shown.name}"
        size = f"{len(page.text) / 1e6:.2g} MB"
        job.say(f"Wrote {job.output} ({counted(shown.mesh.num_cells, 'cell')}{what}, {size})")

    def _shown(self, job: Job) -> Shown:
        if len(job.names) > 1:
            raise MeshError(f"A page shows one scalar, but {len(job.names)} are given by --scalar; choose one.")
        name = job.names[0] if job.names else None
        options = ScalarOptions(
            scalar=name,
            transfer_function=self.transfer_function,
            value_range=self.value_range,
            attenuation=self.attenuation,
        )
        return options.apply(job.data, job.model)

    def _title(self, model: Path) -> str:
        if self.title is not None:
            return self.title
        return model.resolve().parent.name if model.stem == _RESULT else model.stem
