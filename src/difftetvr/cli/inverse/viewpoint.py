"""The command ``difftetvr viewpoint``."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from difftetvr.cli.arguments import Groups
from difftetvr.cli.drawing.scalars import SCALAR_GROUP, ScalarOptions, Shown
from difftetvr.cli.options import TRUST_GROUPS, Color, MeshOptions, TrustOptions, color_of
from difftetvr.errors import CameraError, CaptureError, DiffTetError, FitError, counted
from difftetvr.files import require_writable

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from difftetvr.inverse.viewpoint.search import ViewpointConfig, ViewpointSearch
    from difftetvr.rendering import Camera

_FILES = ("best.png", "worst.png", "map.png", "best.json", "worst.json", "views.json")
_UNFINISHED = "search.json"
_LARGEST_SEARCH = 4096  # pixels of a side


@dataclass(frozen=True)
class Viewpoint:
    """Find from where a volume shows most: climb the entropy of its picture over poses of the camera."""

    model: Annotated[Path, Positional, arg(metavar="MODEL")]
    """Mesh (.vtu, .vtk, .msh, .mesh, .xdmf, .npz, .bintet, .ovm, .node) with color and density, or with scalars."""
    output: Annotated[Path, arg(aliases=["-o"], metavar="OUT")]
    """Folder for pictures of the best and the worst view, their cameras (best.json, for render --camera), a map of the
    sphere, and views.json with all of them."""
    measure: Literal["opacity", "color", "both"] = "opacity"
    """Entropy of the opacity, of the areas of colours, or the sum of both."""
    poses: Literal["orbit", "free"] = "orbit"
    """Cameras that look at the centre from one distance; or whose distance and target change by up to a quarter."""
    starts: int = 8
    """Number of climbs."""
    scouts: int = 64
    """Views spread over the sphere that are rendered first: climbs start from the best of them; 0: from the middles of
    the octants."""
    iterations: int = 30
    """Most pictures of each climb."""
    center: tuple[float, float, float] | None = None
    """What the cameras look at; default: the centre of the mesh."""
    radius: float | None = None
    """Distance of the cameras from it; default: so far that the whole mesh is seen."""
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Direction that points upwards in pictures."""
    fov: float = 53.13
    """Vertical field of view in degrees."""
    width: int = 512
    """Pixels of the pictures that are written."""
    height: int = 512
    """Pixels of the pictures that are written."""
    search_size: int = 128
    """Pixels of the longer side of pictures whose entropy is measured."""
    background: Color = "black"
    """Behind the volume in the pictures that are written: black, white or linear R G B."""
    renderer: Literal["marching", "linked-list", "projected"] | None = None
    """How the cells along a ray are found and ordered; default: marching, or linked-list where cells overlap."""
    device: str | None = None
    """Where to render, such as cpu or cuda; default: the best that works."""
    resume: bool = False
    """Go on with a search that was interrupted, with the same options."""
    overwrite: bool = False
    """Replace a search in OUT that was interrupted."""
    scalars: OmitArgPrefixes[ScalarOptions] = field(default_factory=ScalarOptions)
    mesh: OmitArgPrefixes[MeshOptions] = field(default_factory=MeshOptions)
    trust: OmitArgPrefixes[TrustOptions] = field(default_factory=TrustOptions)
    groups: ClassVar[Groups] = {
        "Search": ("measure", "poses", "starts", "scouts", "iterations", "search-size"),
        "Orbit and pictures": ("center", "radius", "up", "fov", "width", "height", "background"),
        "Scalars of a simulation": SCALAR_GROUP,
        "How it is drawn": ("renderer", "split", "step", "device", "resume", "overwrite"),
        **TRUST_GROUPS,
    }

    def run(self, console: Console) -> None:
        """Searches, and fills the output folder."""
        from difftetvr.fitting.beginning.requirements import resolve_device
        from difftetvr.inverse.viewpoint.search import best_viewpoint
        from difftetvr.terminal import counting

        background = color_of(self.background)
        self._require_sizes()
        unfinished = self._require_free()
        make_folder(self.output, (*_FILES, _UNFINISHED))
        data = self.mesh.load(self.model, console)
        shown, device = self.scalars.apply(data, self.model), resolve_device(self.device)
        if shown.note is not None:
            console.print(shown.note)
        overlaps = not shown.mesh.is_conforming or data.defects.doubled_places > 0
        config = self._config("linked-list" if overlaps else "marching")
        mesh, content = shown.mesh.to(device=device), shown.field.to(device=device)
        try:
            with counting(console, f"Climbing to views of {self.model.name}", "climb") as progress:
                search = best_viewpoint(
                    mesh, content, config, checkpoint=unfinished, resume=self.resume, on_progress=progress
                )
        except KeyboardInterrupt:
            if unfinished.exists():
                console.print("Interrupted; the same command with --resume goes on after the last climb.")
            raise
        self._write(dataclasses.replace(shown, mesh=mesh, field=content), search, config, background)
        unfinished.unlink(missing_ok=True)
        console.print(_table(search))
        console.print(f"{counted(search.renderings, 'picture')} rendered", highlight=False)
        console.print(f"Wrote {self.output / 'best.png'}; its camera: render --camera {self.output / 'best.json'}")

    def _require_free(self) -> Path:
        """The file of the search, after a look at whether there is one already.

        Raises:
            FitError: There is none to go on with, or one that would be lost.
        """
        unfinished = self.output / _UNFINISHED
        if self.resume and self.overwrite:
            raise FitError("A search can go on or be replaced; give one of --resume and --overwrite.")
        if self.resume and not unfinished.exists():
            raise FitError(f"There is no unfinished search in {self.output}; leave out --resume.")
        if unfinished.exists() and not (self.resume or self.overwrite):
            raise FitError(
                f"There is an unfinished search in {self.output}; give --resume, --overwrite or another folder."
            )
        return unfinished

    def _require_sizes(self) -> None:
        if not 0.0 < self.fov < 180.0:
            raise CameraError(f"--fov is {self.fov:g} degrees; it must lie between 0 and 180.")
        for name in ("width", "height"):
            if getattr(self, name) < 1:
                raise CameraError(f"--{name} is {getattr(self, name)}; it must be at least 1.")
        if not 2 <= self.search_size <= _LARGEST_SEARCH:
            raise CameraError(f"--search-size is {self.search_size}; it must lie between 2 and {_LARGEST_SEARCH}.")

    def _config(self, renderer: str) -> ViewpointConfig:
        from difftetvr.inverse.viewpoint.search import ViewpointConfig

        scale = self.search_size / max(self.width, self.height)
        return ViewpointConfig(
            self.measure,
            self.poses,
            self.starts,
            self.scouts,
            self.iterations,
            self.center,
            self.radius,
            self.up,
            math.radians(self.fov),
            max(1, round(scale * self.width)),
            max(1, round(scale * self.height)),
            self.renderer or renderer,
        )

    def _write(
        self, shown: Shown, search: ViewpointSearch, config: ViewpointConfig, background: tuple[float, float, float]
    ) -> None:
        import torch

        from difftetvr.fitting.records.folder import write_json
        from difftetvr.rendering import render, save_camera
        from difftetvr.view.pictures import save_png
        from difftetvr.view.viewpoints import save_viewpoint_map

        for name, view in (("best", search.best), ("worst", search.worst)):
            camera = self._enlarged(view.camera)
            with torch.no_grad():
                image = render(shown.mesh, shown.field, camera, torch.tensor(background), renderer=config.renderer)
            save_png(self.output / f"{name}.png", image.color)
            save_camera(self.output / f"{name}.json", camera)
        save_viewpoint_map(self.output / "map.png", search)
        summary = {
            "model": str(self.model),
            "options": dataclasses.asdict(config),
            "renderings": search.renderings,
            "found": [view.summary() for view in search.found],
            "scouts": [view.summary() for view in search.scouts],
        }
        write_json(self.output / "views.json", summary)

    def _enlarged(self, camera: Camera) -> Camera:
        """The camera of a picture that is written."""
        focal = 0.5 * self.height / math.tan(0.5 * math.radians(self.fov))
        width, height = self.width, self.height
        return type(camera)(camera.world_to_camera, focal, focal, 0.5 * width, 0.5 * height, width, height)


def make_folder(folder: Path, names: tuple[str, ...], error: type[DiffTetError] = CaptureError) -> None:
    """Makes a folder for results, and checks that files of these names can be written there."""
    if folder.exists() and not folder.is_dir():
        raise FitError(f"{folder} is a file, so no folder can have this name; choose another.")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as problem:
        raise FitError(f"The folder {folder} cannot be created ({problem.strerror}); choose another.") from problem
    for name in names:
        require_writable(folder / name, error)


def _table(search: ViewpointSearch) -> Table:
    from rich.table import Table

    from difftetvr.view.viewpoints import longitude_latitude

    table = Table(box=None, pad_edge=False)
    for column in ("view", "entropy", "longitude", "latitude"):
        table.add_column(column, justify="left" if column == "view" else "right")
    rows = [(f"climb {number}", view) for number, view in enumerate(search.found, 1)]
    if search.scouts:
        rows.append((f"best of {len(search.scouts)} scouts", max(search.scouts, key=lambda view: view.entropy)))
    for name, view in [*rows, ("worst", search.worst)]:
        longitude, latitude = longitude_latitude(view, search.center)
        table.add_row(name, f"{view.entropy:.5f}", f"{longitude:.1f}", f"{latitude:.1f}")
    return table
