"""What several commands share: their common options, and how they find a model."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from tyro.conf import FlagCreatePairsOff, arg

from difftetvr.terminal import waiting

if TYPE_CHECKING:
    from rich.console import Console

    from difftetvr.capture.capture import Capture
    from difftetvr.mesh.field import Field
    from difftetvr.mesh.tetmesh import TetMesh

Output = Annotated[Path, arg(aliases=["-o"])]


@dataclass(frozen=True)
class CaptureOptions:
    """Views of a volume, for tooth and volume files; what is not given is as in the Tooth benchmark."""

    transfer_function: str | None = None
    """Transfer function of a volume, .json or .xml."""
    shape: tuple[int, int, int] | None = None
    """Samples along x, y and z of a .raw volume without a header."""
    dtype: str | None = None
    """NumPy type of a .raw volume without a header, such as uint8."""
    spacing: tuple[float, float, float] | None = None
    """Distances of samples along x, y and z; default: the file's."""
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

    def load(self, name: str, console: Console) -> Capture:
        """Reads or renders the capture of that name."""
        from difftetvr.capture import load_capture

        with waiting(console, f"Preparing the views of {name}"):
            return load_capture(name, **dataclasses.asdict(self))


def load_model(path: Path, device: str | None) -> tuple[TetMesh, Field]:
    """A mesh with its field, on the device of that name or the best one."""
    from difftetvr.fit.trainer import resolve_device
    from difftetvr.mesh.io import load

    mesh, field_on_mesh = load(path)
    target = resolve_device(device)
    return mesh.to(device=target), field_on_mesh.to(device=target)


def parse(command: Any, args: Sequence[str], default: Any = tyro.MISSING) -> Any:
    """A command from arguments; options that are not given keep the values of ``default``."""
    return tyro.cli(command, prog="difftetvr", args=args, default=default, config=(FlagCreatePairsOff,))
