"""The command ``difftetvr view``."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from difftetvr.cli.arguments import Groups
from difftetvr.cli.drawing.cameras import CameraOptions, Place
from difftetvr.cli.drawing.scalars import SCALAR_GROUP, ScalarOptions
from difftetvr.cli.live.listening import VIEWER_GROUP, ServerOptions
from difftetvr.cli.options import (
    TRUST_GROUPS,
    CaptureOptions,
    Color,
    MeshOptions,
    TrustOptions,
    VolumeOptions,
    is_volume,
    saying,
)
from difftetvr.errors import CaptureError, DiffTetError
from difftetvr.files import require_writable_folder
from difftetvr.fitting.records.folder import RunFolder

if TYPE_CHECKING:
    import torch
    from rich.console import Console

    from difftetvr.view.live.scene import Scene, Views


@dataclass(frozen=True)
class View:
    """Look at a model, a volume or the cameras of photographs in a browser, live."""

    model: Annotated[Path, Positional, arg(metavar="MODEL|CAPTURE")]
    """Mesh with color and density, or with scalars; the folder of a run; a volume, or tooth; or photographs with their
    cameras, or a saved capture (.npz), of which cameras and points are shown."""
    output: Annotated[Path, arg(aliases=["-o"])] = Path()
    """Folder that the viewer may save pictures, films and transfer functions to, and to no other; default: this one."""
    server: OmitArgPrefixes[ServerOptions] = field(default_factory=ServerOptions)
    camera: Path | None = None
    """File of the camera to begin with, .json, such as the viewer saves it; default: as render looks at it."""
    capture: str | None = None
    """Capture whose cameras and photographs are shown, too; default: that of the run whose model this is."""
    format: Literal["nerf-synthetic", "transforms", "colmap", "cameras", "tiny-nerf", "polycam", "record3d"] | None = (
        None
    )
    """What a folder of photos is; default: found by looking."""
    downscale: int | None = None
    """Pixels of a photo along x and y that are averaged to one; default: as the run did, or to 240 pixels, on CUDA
    1600."""
    background: Color | None = None
    """Behind what is seen at first: black, white or linear R G B; default: black, or that of the run from photographs
    whose model this is."""
    renderer: Literal["marching", "linked-list", "projected"] | None = None
    """How the cells along a ray are found and ordered; default: marching, or linked-list where cells overlap."""
    device: str | None = None
    """Where to render, such as cpu or cuda; default: the best that works."""
    scalars: OmitArgPrefixes[ScalarOptions] = field(default_factory=ScalarOptions)
    mesh: OmitArgPrefixes[MeshOptions] = field(default_factory=MeshOptions)
    volume: OmitArgPrefixes[VolumeOptions] = field(default_factory=VolumeOptions)
    trust: OmitArgPrefixes[TrustOptions] = field(default_factory=TrustOptions)
    groups: ClassVar[Groups] = {
        "Who can look": VIEWER_GROUP,
        "Photographs": ("capture", "format", "downscale"),
        "Scalars of a simulation, and volumes": SCALAR_GROUP,
        "How it is drawn": ("camera", "background", "renderer", "device"),
        "How it is read": ("split", "step", "shape", "dtype", "spacing"),
        **TRUST_GROUPS,
    }

    def run(self, console: Console) -> None:
        """Serves pages until it is interrupted."""
        from difftetvr.fitting.beginning.requirements import resolve_device
        from difftetvr.view.live.server import Listening, LiveServer, require_viewer

        self.server.require_valid()
        require_viewer()
        require_writable_folder(self.output, CaptureError)
        scene = self._scene(resolve_device(self.device), console)
        with LiveServer(scene, Listening(self.output, self.server.host, self.server.port)) as server:
            console.print(server.announcement, highlight=False, soft_wrap=True)
            console.print(f"What is saved goes to {self.output.resolve()}; stop with Ctrl-C.", highlight=False)
            server.serve()

    def _scene(self, device: torch.device, console: Console) -> Scene:
        from difftetvr.capture import is_photo_source, is_projection_source
        from difftetvr.mesh.io import is_mesh_archive

        folder = RunFolder(self.model)
        if folder.model.is_file() and folder.config.is_file():
            return replace(self, model=folder.model)._scene(device, console)
        if is_volume(self.model):
            return self._volume_scene(device, console)
        if is_projection_source(str(self.model)):
            raise CaptureError(f"{self.model} holds projections, of which the viewer shows nothing; name a model.")
        is_saved_capture = self.model.suffix.lower() == ".npz" and not is_mesh_archive(self.model)
        if self.format is not None or is_photo_source(self.model) or is_saved_capture:
            return self._capture_scene(console)
        return self._mesh_scene(device, console)

    def _mesh_scene(self, device: torch.device, console: Console) -> Scene:
        from difftetvr.cli.drawing.subjects import renderer_for
        from difftetvr.cli.live.scenes import scene_around
        from difftetvr.rendering import ScalarField
        from difftetvr.view.live.contents import MeshContent
        from difftetvr.view.live.settings import ScalarLook, Settings

        if given := self.volume.given():
            raise DiffTetError(f"{self.model} is a mesh, of which --{given[0]} says nothing; leave it out.")
        data = self.mesh.load(self.model, console)
        place = Place(self.model, CameraOptions(camera=self.camera, capture=self.capture), console)
        shown = self.scalars.apply(data, self.model)
        if shown.note is not None:
            console.print(shown.note)
        renderer = renderer_for(shown.mesh, data.defects, self.renderer)
        content = MeshContent(shown.mesh.to(device=device), shown.field.to(device=device), renderer)
        look = None
        if isinstance(shown.field, ScalarField):
            look = ScalarLook(shown.field.transfer_function, shown.field.limits, shown.density)
        views = self._views_of(place, console)
        settings = Settings(background=place.background(self.background), look=look)
        return scene_around(self.model.name, content, place, views, settings, shown.name)

    def _volume_scene(self, device: torch.device, console: Console) -> Scene:
        from difftetvr.cli.live.scenes import scene_around
        from difftetvr.view.live.contents import VolumeContent
        from difftetvr.view.live.settings import ScalarLook, Settings

        for name, value in (("scalar", self.scalars.scalar), ("capture", self.capture), ("format", self.format)):
            if value is not None:
                raise CaptureError(f"{self.model} is a volume, of which --{name} says nothing; leave it out.")
        given = self.scalars
        volume, function = self.volume.load(str(self.model), given.transfer_function, given.value_range, console)
        shown = given.apply_to_volume(volume, function)
        look = ScalarLook(shown.function, shown.scale.value_range, shown.density)
        content = VolumeContent(volume, look, device)
        place = Place(self.model, CameraOptions(camera=self.camera), console)
        settings = Settings(background=place.background(self.background), look=look)
        return scene_around(self.model.name, content, place, None, settings, "value")

    def _capture_scene(self, console: Console) -> Scene:
        import torch

        from difftetvr.capture import CameraSet
        from difftetvr.view.live.scene import Scene, Views
        from difftetvr.view.live.settings import Settings

        options = CaptureOptions(format=self.format, downscale=self.downscale)
        name = str(self.model)
        capture = options.sized_for(name, self.device, console).load(name, console)
        cameras = CameraSet(capture.cameras, capture.test, capture.name)
        up = tuple(cameras.up.tolist())
        # From outside, so that all cameras are seen: there is nothing else.
        asked = CameraOptions(camera=self.camera, up=None if self.camera is not None else up)
        place, positions = Place(self.model, asked, console), torch.from_numpy(cameras.positions)
        everything = torch.cat((capture.bounds.double(), positions))
        (start,) = place.shots(torch.stack((everything.amin(0), everything.amax(0)))).cameras
        settings = Settings(background=place.background(self.background))
        return Scene(capture.name, None, capture.bounds.double(), start, up, settings, Views.of(capture))

    def _views_of(self, place: Place, console: Console) -> Views | None:
        """The views of the capture that a model comes from; None, with a line that says so, where they are gone."""
        from difftetvr.capture import CameraSet, load_cameras
        from difftetvr.view.live.scene import Views

        run = place.run
        name = self.capture or (None if run is None else run.capture)
        if name is None:
            return None
        options = CaptureOptions() if run is None else run.capture_options
        if self.downscale is not None:
            options = replace(options, downscale=self.downscale)
        try:
            if place.is_of_photographs:
                capture = options.sized_for(name, self.device, console).load(name, console)
                place.take(CameraSet(capture.cameras, capture.test, capture.name))
                return Views.of(capture)
            with saying(console):
                return Views.of(load_cameras(name, **options.given()))
        except DiffTetError as error:
            if self.capture is not None:
                raise
            console.print(f"Without the cameras of its run, which cannot be read: {error}", highlight=False)
            return None
