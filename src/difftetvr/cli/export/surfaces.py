"""Surfaces on which a scalar has a level: which scalar, which level, and in which colours."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from difftetvr.cli.export.job import Job, dtype_for
from difftetvr.errors import CaptureError, DiffTetError, MeshError, counted

if TYPE_CHECKING:
    import torch

    from difftetvr.mesh.io import Scalar
    from difftetvr.sampling.isosurfaces import CrossedEdges
    from difftetvr.srgb import Encoding

_HALVING_SHARE = 0.2  # of the mesh's longest side, within which density of the usual level halves light


@dataclass(frozen=True)
class SurfaceOptions:
    """Where a surface is, and what its colours are."""

    level: float | None = None
    """Value at which the surface is; default: of density, what halves light within a fifth of the mesh's longest side;
    of others, the middle of their range."""
    colors: Literal["linear", "srgb"] | None = None
    """What the colors of MODEL are; default: srgb where it lies in the folder of a run on photographs, else linear."""

    def write(self, job: Job) -> None:
        """Finds and writes the surface."""
        from difftetvr.sampling import save_surface
        from difftetvr.sampling.isosurfaces import at_vertices, crossed_edges

        if self.level is not None and not math.isfinite(self.level):
            raise MeshError(f"--level is {self.level:g}; give a finite number.")
        scalar = _scalar(job)
        mesh = scalar.mesh.to(dtype=dtype_for([scalar.values]))
        values = scalar.values.to(mesh.vertices.dtype)
        if scalar.location == "cell":
            values = at_vertices(mesh, values)
            job.say(f"'{scalar.name}' is constant in cells; the means of those around each vertex are taken.")
        level = self._level(job, scalar, values)
        edges = crossed_edges(mesh, values, level)
        if not len(edges.triangles):
            raise MeshError(_why_empty(scalar, values, level))
        places = edges.interpolated(mesh.positions if any(mesh.origin) else mesh.vertices)
        colors, encoding = _colors(job, scalar, edges), self.colors or "linear"
        if colors is not None and self.colors is None:
            encoding = _encoding(job)
        save_surface(job.output, places, edges.triangles, colors, encoding)
        what = f"{counted(len(edges.triangles), 'triangle')}, {scalar.name} {level + scalar.offset:g}"
        job.say(f"Wrote {job.output} ({what})")

    def _level(self, job: Job, scalar: Scalar, values: torch.Tensor) -> float:
        if self.level is not None:
            return scalar.counted_from_offset(self.level)
        least, greatest = (float(v) for v in values.aminmax())
        level, why = least + 0.5 * (greatest - least), "the middle of its range"
        lower, upper = scalar.mesh.bounds().double()
        halving = math.log(2.0) / (_HALVING_SHARE * float((upper - lower).max()))
        if job.data.field is not None and scalar.name == "density" and least < halving < greatest:
            level, why = halving, "which halves light within a fifth of the mesh's longest side"
        job.say(f"The level of '{scalar.name}' is {level + scalar.offset:g}, {why}; --level chooses another.")
        return level


def _scalar(job: Job) -> Scalar:
    """What a surface is of.

    Raises:
        MeshError: There is no such data, or several are named.
    """
    from difftetvr.mesh.io import scalar_of

    if len(job.names) > 1:
        raise MeshError(f"A surface is that of one scalar; name one of {', '.join(job.names)} with --scalar.")
    name = job.names[0] if job.names else None if job.data.field is None else "density"
    with job.naming_model():
        scalar = scalar_of(job.data, job.of_field(name))
    job.say_missing(scalar)
    return scalar


def _why_empty(scalar: Scalar, values: torch.Tensor, level: float) -> str:
    least, greatest = (float(v) + scalar.offset for v in values.aminmax())
    if least == greatest:
        return f"'{scalar.name}' is {least:g} everywhere, so it has no surface; name other data with --scalar."
    return (
        f"The surface of '{scalar.name}' at {level + scalar.offset:g} is empty, as its values lie from {least:g} to "
        f"{greatest:g}; choose a --level between these."
    )


def _colors(job: Job, scalar: Scalar, edges: CrossedEdges) -> torch.Tensor | None:
    """(P, 3) colours on the surface, where the model has any."""
    from difftetvr.sampling.isosurfaces import at_vertices

    mesh, field = job.data.mesh, job.data.field
    if field is None:
        return None
    if field.harmonics is not None:
        job.say("What its colors owe to the direction is left out.")
    table = at_vertices(mesh, field.color) if field.location_on(mesh) == "cell" else field.color
    return edges.interpolated(table if scalar.vertices is None else table[scalar.vertices])


def _encoding(job: Job) -> Encoding:
    """What the colours of a model are: those of the images that it was fitted to, as far as its folder tells."""
    from difftetvr.archive import read_arrays
    from difftetvr.capture.photos.photo_capture import is_photo_source
    from difftetvr.capture.volumes.readers.table import is_volume_file
    from difftetvr.capture.volumes.volume_capture import TOOTH

    run = job.run
    capture = None if run is None else run.capture
    if capture is None or capture == TOOTH or is_volume_file(capture):
        return "linear"
    if Path(capture).suffix.lower() == ".npz" and not is_photo_source(capture):
        try:
            stored = read_arrays(capture, CaptureError, lambda name, _: name == "encoding")
        except DiffTetError:
            return "linear"
        if str(stored.get("encoding")) != "srgb":
            return "linear"
    job.say("Its colors are taken as sRGB-encoded, as those of the photographs that it was fitted to are.")
    return "srgb"
