"""What several commands share: their common options, and how they find a model."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import arg

from difftetvr.cli.arguments import Groups
from difftetvr.errors import CaptureError
from difftetvr.fitting.config import BACKGROUND_COLORS
from difftetvr.terminal import waiting

if TYPE_CHECKING:
    from rich.console import Console

    from difftetvr.capture.capture import Capture
    from difftetvr.capture.volumes.summary import VolumeSummary
    from difftetvr.capture.volumes.volume import Volume
    from difftetvr.mesh.field import Field
    from difftetvr.mesh.io import MeshData
    from difftetvr.mesh.tetmesh import TetMesh
    from difftetvr.optics.transfer_function import TransferFunction

# Half an hour on two cores; beyond, a reconstruction from photographs takes hours there.
_LONGEST_SIDE, _LONGEST_SIDE_ON_CUDA = 240, 1600

# Of volumes that may say something of images, too.
_OF_VOLUMES = ("transfer_function", "shape", "dtype", "spacing", "value_range", "attenuation")

Output = Annotated[Path, arg(aliases=["-o"])]

Color = Literal["black", "white"] | tuple[float, float, float]
"""Of a background: its name, or R G B as the picture's are, linear or sRGB-encoded."""

TRUST_GROUPS: Groups = {"How far files are trusted": ("allow-outside", "allow-large")}
"""Where `TrustOptions` stand in the help of a command."""

CAPTURE_GROUPS: Groups = {
    "How photographs are read": ("downscale", "format", "bounds", "test-every", "keep-lens"),
    "How a volume is read and seen": (
        *("transfer-function", "shape", "dtype", "spacing", "value-range", "attenuation"),
        *("views", "width", "height", "radius", "orbit"),
    ),
    **TRUST_GROUPS,
}
"""Where `CaptureOptions` and `TrustOptions` stand in the help of a command."""


@dataclass(frozen=True)
class TrustOptions:
    """How far files from strangers are trusted."""

    allow_outside: Path | None = None
    """Folder below which files may lie that another file names; default: only in the folder of the file that names
    them."""
    allow_large: bool = False
    """Unpack compressed data to more than 1 GiB and 20 times the size of the file."""


@dataclass(frozen=True)
class CaptureOptions:
    """How images are read, or a volume is seen; what is not given is found by looking, or as in the Tooth benchmark."""

    format: Literal["nerf-synthetic", "transforms", "colmap", "cameras", "tiny-nerf", "polycam", "record3d"] | None = (
        None
    )
    """What a folder of photos is; default: found by looking."""
    downscale: int | None = None
    """Pixels of a photo along x and y that are averaged to one; default: so many that the longer side has at most 240
    pixels, on CUDA 1600; for info 1."""
    bounds: tuple[float, float, float, float, float, float] | None = None
    """Box to reconstruct from photos, its lower and its upper corner; default: found."""
    keep_lens: bool = False
    """Leave photos as their lens has distorted them, and render through it; default: resample them to a pinhole's."""

    transfer_function: str | None = None
    """Transfer function of a volume, .json or .xml."""
    shape: tuple[int, int, int] | None = None
    """Samples along x, y and z of a .raw volume without a header."""
    dtype: str | None = None
    """NumPy type of a .raw volume without a header, such as uint8."""
    spacing: tuple[float, float, float] | None = None
    """Distances of samples along x, y and z; default: the file's."""
    value_range: tuple[float, float] | None = None
    """Values that stand for 0 and 1 of the transfer function; default: 0 and 255 for uint8, else the least and the
    greatest one."""
    attenuation: float | None = None
    """Density of opacity 1, where the box's longest side is 1."""
    views: int | None = None
    """Number of views."""
    width: int | None = None
    """Pixels of a view."""
    height: int | None = None
    """Pixels of a view."""
    radius: float | None = None
    """Distance of the cameras from the centre."""
    orbit: Literal["fibonacci", "random"] | None = None
    """Cameras on a spiral over the sphere, or at random places of it."""
    test_every: int | None = None
    """One of so many views is held out; 0: none."""

    def for_images(self, name: str) -> CaptureOptions:
        """These options where those of volumes say what else is known of images, for which there is nothing to render.

        Args:
            name: Of the capture; a volume keeps its options.
        """
        if is_volume(name):
            return self
        unused: dict[str, Any] = dict.fromkeys(_OF_VOLUMES)
        return dataclasses.replace(self, **unused)

    def sized_for(self, name: str, device: str | None, console: Console) -> CaptureOptions:
        """These options; where they leave the size of photographs open, with one that suits a device.

        Args:
            name: Of the capture.
            device: Name of the device; None: the best one.
            console: Where to say what was chosen.
        """
        from difftetvr.capture import CaptureWarning, PhotoCapture, is_photo_source
        from difftetvr.fitting.beginning.requirements import resolve_device

        if self.downscale is not None or not (self.format or is_photo_source(name)):
            return self
        with warnings.catch_warnings():
            # They are said when the images are read.
            warnings.simplefilter("ignore", CaptureWarning)
            longest_side = _LONGEST_SIDE_ON_CUDA if resolve_device(device).type == "cuda" else _LONGEST_SIDE
            with waiting(console, f"Looking at the images of {name}"):
                downscale = PhotoCapture(name, self.format).fitting_downscale(longest_side)
        if downscale > 1:
            console.print(f"Chosen for this machine: --downscale {downscale}", highlight=False)
        return dataclasses.replace(self, downscale=downscale)

    def given(self) -> dict[str, Any]:
        """Those that are not left as they are by default, by name."""
        values = ((item, getattr(self, item.name)) for item in dataclasses.fields(self))
        return {item.name: value for item, value in values if value != item.default}

    def in_words(self) -> list[str]:
        """Those that are given, as words of a command line."""
        words = []
        for name, value in self.given().items():
            values = value if isinstance(value, tuple) else () if value is True else (value,)
            words += [f"--{name.replace('_', '-')}", *map(str, values)]
        return words

    def load(self, name: str, console: Console) -> Capture:
        """Reads or renders the capture of that name."""
        from difftetvr.capture import load_capture

        with saying(console), waiting(console, f"Preparing the views of {name}"):
            return load_capture(name, **self.given())

    def summarise(self, name: str, console: Console) -> VolumeSummary:
        """Reads the volume of that name without rendering it."""
        from difftetvr.capture.volumes.summary import summarise

        with saying(console), waiting(console, f"Reading {name}"):
            return summarise(name, self.shape, self.dtype, self.spacing, self.value_range)


def is_volume(name: str | Path) -> bool:
    """Whether a name is that of the built-in scan or of a volume's file."""
    from difftetvr.capture import TOOTH, is_volume_file

    return str(name) == TOOTH or is_volume_file(name)


@contextlib.contextmanager
def saying(console: Console, as_words: Callable[[str], str] = str) -> Iterator[None]:
    """Context in which warnings about captures are lines of the output, once it ends well.

    Args:
        console: Where to say them.
        as_words: Puts what they say in the words of the command line.
    """
    from difftetvr.capture import CaptureWarning

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", CaptureWarning)
        yield
    for warning in caught:
        console.print(as_words(str(warning.message)), highlight=False)


@dataclass(frozen=True)
class MeshOptions:
    """How a mesh file is read."""

    split: bool = False
    """Split hexahedra, wedges, pyramids and polyhedra into tetrahedra, and straighten cells of higher order; what only
    draws does so anyway."""
    step: int | None = None
    """Time step to read of a file that has several, from 0; negative ones count from the last; default: the last."""

    def load(
        self, path: Path, console: Console | None = None, *, require_field: bool = False, only_draws: bool = True
    ) -> MeshData:
        """Reads a mesh with its data, less its flat cells, which show nothing.

        Args:
            path: The mesh file.
            console: Where to say what was left out.
            require_field: Insist on color and density.
            only_draws: Whether nothing but pictures and numbers comes of it, for which cells are split unasked.
        """
        from difftetvr.mesh.io import load_data

        split = None if only_draws and not self.split else self.split
        data = load_data(path, split=split, flat="drop", step=self.step, loose=True, require_field=require_field)
        if console is not None:
            for warning in data.warnings:
                console.print(warning)
        return data


@dataclass(frozen=True)
class VolumeOptions:
    """How a volume is read."""

    shape: tuple[int, int, int] | None = None
    """Samples along x, y and z of a .raw volume without a header."""
    dtype: str | None = None
    """NumPy type of a .raw volume without a header, such as uint8."""
    spacing: tuple[float, float, float] | None = None
    """Distances of samples of a volume along x, y and z; default: the file's."""

    def given(self) -> list[str]:
        """Names of those that are given."""
        return [item.name for item in dataclasses.fields(self) if getattr(self, item.name) is not None]

    def load(
        self,
        name: str,
        transfer_function: Path | None,
        value_range: tuple[float, float] | None,
        console: Console,
    ) -> tuple[Volume, TransferFunction | None]:
        """The volume of a name, and the transfer function that belongs to it.

        Args:
            name: Its path, or ``tooth``, which has a transfer function of its own.
            transfer_function: File of another one; None: none is read.
            value_range: Values that stand for 0 and 1 of it; of volumes without one all values are kept.
            console: Where to say what was found.
        """
        from difftetvr.capture import TOOTH, CaptureWarning, Volume, VolumeCapture

        given = None if transfer_function is None else str(transfer_function)
        with saying(console), waiting(console, f"Reading {name}"):
            if given is not None or name == TOOTH:
                source = VolumeCapture(name, self.shape, self.dtype, self.spacing, given, value_range=value_range)
                return source.load_volume()
            # Their range is that of a transfer function which is yet to be chosen.
            warnings.filterwarnings("ignore", r".* stand for 0 to 1 of the transfer function", CaptureWarning)
            return Volume.load(name, self.shape, self.dtype, self.spacing), None


def color_of(background: Color) -> tuple[float, float, float]:
    """R G B of a background.

    Raises:
        CaptureError: It is not finite.
    """
    rgb = BACKGROUND_COLORS[background] if isinstance(background, str) else background
    if not all(math.isfinite(value) for value in rgb):
        given = " ".join(f"{value:g}" for value in rgb)
        raise CaptureError(f"--background is {given}; give black, white or three finite numbers.")
    return rgb


def load_model(
    path: Path, device: str | None, options: MeshOptions | None = None, console: Console | None = None
) -> tuple[TetMesh, Field]:
    """A mesh with its field, on the device of that name or the best one.

    Args:
        path: The mesh file.
        device: Name of the device; None: the best one.
        options: How to read the file.
        console: Where to say what was left out of it.
    """
    from difftetvr.fitting.beginning.requirements import resolve_device

    data = (options or MeshOptions()).load(path, console, require_field=True)
    assert data.field is not None
    target = resolve_device(device)
    return data.mesh.to(device=target), data.field.to(device=target)
