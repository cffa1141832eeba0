"""The command ``difftetvr render``."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from difftetvr.cli.arguments import Groups
from difftetvr.cli.drawing.cameras import CAMERA_GROUPS, CameraOptions, Place, Shots
from difftetvr.cli.drawing.scalars import SCALAR_GROUP, ScalarOptions, Shown
from difftetvr.cli.options import TRUST_GROUPS, Color, MeshOptions, TrustOptions, VolumeOptions, color_of, is_volume
from difftetvr.errors import CaptureError, DiffTetError, counted
from difftetvr.files import require_writable

if TYPE_CHECKING:
    import torch
    from PIL.Image import Image
    from rich.console import Console

    from difftetvr.cli.drawing.subjects import MeshSubject, VolumeSubject
    from difftetvr.mesh import TetMesh
    from difftetvr.mesh.io import Defects, MeshData
    from difftetvr.view.frames import FrameStyle

__all__ = ["Render", "ScalarOptions", "Shown"]

_WORST_SHOWN = 1e-3


@dataclass(frozen=True)
class PaperOptions:
    """What is around a volume in its picture."""

    transparent: bool = False
    """Nothing behind the volume: the picture is transparent there."""
    colorbar: bool = False
    """Which colour the scalar has where, beside it."""
    axes: bool = False
    """A box around it, with coordinates."""
    unit: str | None = None
    """Unit of these, such as mm."""


@dataclass(frozen=True)
class Render:
    """Render a picture or a film of a volume: a reconstruction, a simulation's scalars, or a scan."""

    model: Annotated[Path, Positional, arg(metavar="MODEL")]
    """Mesh (.vtu, .vtk, .msh, .mesh, .xdmf, .npz, .bintet, .ovm, .node) with color and density, or with scalars; or a
    volume (.nrrd, .vti, .mha, .nii, .raw, ...), or tooth."""
    output: Annotated[Path, arg(aliases=["-o"])]
    """The picture, .png; of a film .mp4, .webm, .webp, .gif, or a folder of pictures."""
    background: Color | None = None
    """Behind the volume: black, white or linear R G B; default: black, or that of the run from photographs whose model
    this is."""
    save_transfer_function: Path | None = None
    """File to write the scalar's transfer function to, .json, to go on from."""
    clip: tuple[float, float, float, float] | None = None
    """A B C D: show only what lies in the half-space A x + B y + C z + D >= 0."""
    shade: bool = False
    """Let a light fall on it: gradient shading."""
    light: tuple[float, float, float] | None = None
    """Direction to the light; default: over the camera's left shoulder."""
    show: Literal["image", "depth-complexity", "cell-quality"] = "image"
    """The image; or how many cells each ray crosses; or the worst quality among them, from 0 (flat) to 1 (regular)."""
    renderer: Literal["marching", "linked-list", "projected"] | None = None
    """How the cells along a ray are found and ordered; default: marching, or linked-list where cells overlap."""
    device: str | None = None
    """Where to render, such as cpu or cuda; default: the best that works."""
    view_from: OmitArgPrefixes[CameraOptions] = field(default_factory=CameraOptions)
    scalars: OmitArgPrefixes[ScalarOptions] = field(default_factory=ScalarOptions)
    paper: OmitArgPrefixes[PaperOptions] = field(default_factory=PaperOptions)
    mesh: OmitArgPrefixes[MeshOptions] = field(default_factory=MeshOptions)
    volume: OmitArgPrefixes[VolumeOptions] = field(default_factory=VolumeOptions)
    trust: OmitArgPrefixes[TrustOptions] = field(default_factory=TrustOptions)
    groups: ClassVar[Groups] = {
        **CAMERA_GROUPS,
        "Scalars of a simulation, and volumes": (*SCALAR_GROUP, "save-transfer-function"),
        "How it is drawn": ("background", "transparent", "colorbar", "axes", "unit", "shade", "light", "clip"),
        "How it is computed": ("show", "renderer", "device"),
        "How MODEL is read": ("split", "step", "shape", "dtype", "spacing"),
        **TRUST_GROUPS,
    }

    def run(self, console: Console) -> None:
        """Renders, and writes the picture or the film."""
        from difftetvr.fitting.beginning.requirements import resolve_device
        from difftetvr.rendering import OrderWarning

        self._require_valid()
        data = None if is_volume(self.model) else self.mesh.load(self.model, console)
        place, device = Place(self.model, self.view_from, console), resolve_device(self.device)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", OrderWarning)
            if data is None:
                self._draw(self._volume_subject(device, console), place, console)
            elif self.show == "image":
                self._draw(self._mesh_subject(data, device, console), place, console)
            else:
                self._draw_statistics(data.mesh.to(device=device), data.defects, place, console)
        for message in dict.fromkeys(str(warning.message) for warning in caught):
            console.print(message, highlight=False)

    def _require_valid(self) -> None:
        """Refuse what can be refused before anything is read."""
        from difftetvr.view.frames.films import is_film, require_film
        from difftetvr.view.pictures import require_png

        self.view_from.require_valid()
        is_asked_for = self.view_from.film.is_asked_for
        if is_asked_for:
            if self.show != "image":
                raise CaptureError(f"Films show the image; leave out --show {self.show}, or the film.")
            require_film(self.output)
        elif is_film(self.output) and self.output.suffix:
            raise CaptureError(f"{self.output} is the name of a film; make one with --turntable or --path.")
        else:
            require_png(self.output)
            require_writable(self.output, CaptureError)
        if self.save_transfer_function is not None:
            if self.save_transfer_function.suffix.lower() != ".json":
                raise CaptureError(
                    f"Transfer functions are written as .json, which {self.save_transfer_function} is not; rename it."
                )
            require_writable(self.save_transfer_function, CaptureError)
        if self.background is not None:
            color_of(self.background)
            if self.paper.transparent:
                raise CaptureError("--transparent leaves no background; leave out --background, or --transparent.")
        if self.paper.unit is not None and not self.paper.axes:
            raise CaptureError(f"--unit {self.paper.unit} is what --axes are told in; give both.")
        if self.show != "image":
            self._require_statistics()
        if self.light is not None and not (self.shade and any(self.light)):
            raise CaptureError("--light is the direction to the light of --shade, and not 0 0 0; give both.")

    def _require_statistics(self) -> None:
        """Refuse options of an image for what is none."""
        given = {
            "transparent": self.paper.transparent,
            "colorbar": self.paper.colorbar,
            "axes": self.paper.axes,
            "background": self.background is not None,
            "shade": self.shade,
            "save-transfer-function": self.save_transfer_function is not None,
        } | dict.fromkeys(self.scalars.given(), True)
        for name, is_given in given.items():
            if is_given:
                raise CaptureError(f"--{name} is for the image; leave it out, or --show {self.show}.")

    def _mesh_subject(self, data: MeshData, device: torch.device, console: Console) -> MeshSubject:
        from difftetvr.cli.drawing.subjects import Drawing, MeshSubject, renderer_for

        if given := self.volume.given():
            raise DiffTetError(f"{self.model} is a mesh, of which --{given[0]} says nothing; leave it out.")
        shown = self.scalars.apply(data, self.model)
        if shown.note is not None:
            console.print(shown.note)
        renderer = renderer_for(shown.mesh, data.defects, self.renderer)
        drawing = Drawing(renderer, self.clip, self.shade, self.light)
        return MeshSubject(shown, drawing, device)

    def _volume_subject(self, device: torch.device, console: Console) -> VolumeSubject:
        from difftetvr.cli.drawing.subjects import VolumeSubject

        for name, value in (
            ("clip", self.clip),
            ("shade", self.shade),
            ("scalar", self.scalars.scalar),
            ("renderer", self.renderer),
        ):
            if value:
                raise CaptureError(f"{self.model} is a volume, and --{name} is for meshes; leave it out.")
        if self.show != "image":
            raise CaptureError(f"{self.model} is a volume, which has no cells to count; leave out --show.")
        given = self.scalars
        volume, function = self.volume.load(str(self.model), given.transfer_function, given.value_range, console)
        return VolumeSubject(given.apply_to_volume(volume, function), device)

    def _draw(self, subject: MeshSubject | VolumeSubject, place: Place, console: Console) -> None:
        """Writes the picture, or the film, of a subject."""
        from difftetvr.view.frames import FrameStyle
        from difftetvr.view.frames.axes import ROOM as ROOM_FOR_AXES
        from difftetvr.view.frames.color_bar import ROOM as ROOM_FOR_BAR
        from difftetvr.view.frames.visible import glance, zoomed

        if self.paper.colorbar and subject.scale is None:
            raise CaptureError(f"{self.model} shows its own colours, not a scalar's; leave out --colorbar.")
        has_bar, has_axes = self.paper.colorbar, self.paper.axes
        room = (ROOM_FOR_BAR if has_bar else 0.0, ROOM_FOR_AXES if has_axes else 0.0)
        shots = place.shots(subject.bounds, room)
        if shots.is_chosen and not has_axes:
            (camera,) = shots.cameras
            shots = replace(shots, cameras=[zoomed(camera, subject.seen_by(glance(camera)).alpha, room)])
        style = FrameStyle(
            None if self.paper.transparent else place.background(self.background),
            subject.scale if has_bar else None,
            subject.axes(self.paper.unit or "") if has_axes else None,
        )
        if shots.fps is None:
            self._write_picture(subject, shots, style, console)
        else:
            self._write_film(subject, shots, style, console)
        if self.save_transfer_function is not None:
            self._save_function(self.save_transfer_function, subject, console)

    def _write_picture(
        self, subject: MeshSubject | VolumeSubject, shots: Shots, style: FrameStyle, console: Console
    ) -> None:
        from difftetvr.cli.drawing.subjects import over
        from difftetvr.view.frames import framed
        from difftetvr.view.pictures import save_picture

        camera = shots.cameras[0]
        image = subject.seen_by(camera)
        save_picture(self.output, framed(image.color, image.alpha, camera, style))
        background = style.background
        behind = (0.0, 0.0, 0.0) if background is None else background
        if (reason := subject.why_blank(camera, over(image, behind), behind)) is not None:
            console.print(reason, highlight=False)
        what = "" if subject.name is None else f", {subject.name}"
        console.print(f"Wrote {self.output} ({camera.width} x {camera.height}{what})", highlight=False)

    def _write_film(
        self, subject: MeshSubject | VolumeSubject, shots: Shots, style: FrameStyle, console: Console
    ) -> None:
        from difftetvr.terminal import waiting
        from difftetvr.view.frames import framed, save_film
        from difftetvr.view.frames.films import require_shown

        assert shots.fps is not None
        camera, count = shots.cameras[0], counted(len(shots.cameras), "frame")
        require_shown(self.output, (camera.width, camera.height), shots.fps, style.background is None)

        def frames() -> Iterator[Image]:
            for camera in shots.cameras:
                image = subject.seen_by(camera)
                yield framed(image.color, image.alpha, camera, style)

        with waiting(console, f"Rendering {count}"):
            save_film(self.output, frames(), shots.fps)
        what = f"{count} of {camera.width} x {camera.height}, {shots.fps:g} a second"
        console.print(f"Wrote {self.output} ({what})", highlight=False)

    def _save_function(self, path: Path, subject: MeshSubject | VolumeSubject, console: Console) -> None:
        if subject.scale is None:
            raise CaptureError(f"{self.model} shows its own colours and no transfer function's; leave out {path}.")
        subject.scale.transfer_function.save(path)
        low, high = subject.scale.value_range
        options = f"--transfer-function {path} --value-range {low:.9g} {high:.9g} --attenuation {subject.density:.6g}"
        console.print(f"Wrote {path}; the same picture: {options}", highlight=False)

    def _draw_statistics(self, mesh: TetMesh, defects: Defects, place: Place, console: Console) -> None:
        from difftetvr.cli.drawing.subjects import renderer_for
        from difftetvr.rendering.inspection import inspect_rays
        from difftetvr.view.heatmap import Scale, save_heatmap

        (camera,) = place.shots(mesh.bounds().double().cpu()).cameras
        statistics = inspect_rays(mesh, camera, renderer_for(mesh, defects, self.renderer), self.clip)
        if self.show == "depth-complexity":
            values = statistics.depth_complexity.float()
            most, mean = int(values.max()), float(values.mean())
            save_heatmap(self.output, values, Scale("cells crossed", 0.0, max(most, 1)))
            found = f"up to {counted(most, 'cell')} a ray, {mean:.1f} on average"
        else:
            values = statistics.worst_quality
            save_heatmap(self.output, values, Scale("worst quality Q", _WORST_SHOWN, 1.0, is_logarithmic=True))
            seen = values[~values.isnan()]
            found = f"worst quality seen {float(seen.min()):.3g}" if seen.numel() else "no cell in sight"
        console.print(f"Wrote {self.output} ({found})", highlight=False)
