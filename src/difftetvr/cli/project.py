"""The command ``difftetvr project``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from difftetvr.cli.arguments import Groups
from difftetvr.cli.options import TRUST_GROUPS, Output, TrustOptions, saying
from difftetvr.errors import CaptureError, counted
from difftetvr.files import require_writable
from difftetvr.terminal import counting, waiting

if TYPE_CHECKING:
    from rich.console import Console

    from difftetvr.capture import ProjectionGeometry, VoxelVolume

_SAME_SHAPE = 0.01  # by which the proportions of voxels may differ from those that their file tells


@dataclass(frozen=True)
class Project:
    """Make the projections that a tomograph would measure of a volume: exact line integrals of its voxels."""

    volume: Annotated[Path, Positional, arg(metavar="VOLUME")]
    """Volume file. Floats are attenuations per unit of the geometry; integers stand for 0 to 1, see --value-range."""
    geometry: Path
    """Where source and detector are, JSON: a description of ours, or a dictionary of TIGRE or ASTRA. The voxels fill
    its volume_size."""
    output: Output
    """File to write: .npz, or .h5 with the package h5py."""
    noise: str | None = None
    """Noise to add, such as poisson:1e4,gaussian:10: photons of a pixel that sees nothing, standard deviation of the
    electronics in counts. As TIGRE has it, the darkest pixel keeps 1/e of the photons; with scale:1 behind it,
    exp(-line integral)."""
    seed: int = 0
    """Of the noise."""
    method: Literal["siddon", "trilinear"] = "siddon"
    """siddon: values are constant in voxels, as TIGRE's and ASTRA's; trilinear: linear between their middles."""
    holdout_every: int = 0
    """One of so many views is held out of reconstructions; 0: none."""
    shape: tuple[int, int, int] | None = None
    """Samples along x, y and z of a .raw volume without a header."""
    dtype: str | None = None
    """NumPy type of a .raw volume without a header, such as uint8."""
    value_range: tuple[float, float] | None = None
    """Values that stand for 0 and 1; default: floats are what they are, of uint8 0 and 255, of other integers the least
    and the greatest one."""
    device: str | None = None
    """Where to compute, such as cpu or cuda; default: the best that works."""
    trust: OmitArgPrefixes[TrustOptions] = field(default_factory=TrustOptions)
    groups: ClassVar[Groups] = {"How VOLUME is read": ("shape", "dtype", "value-range"), **TRUST_GROUPS}

    def run(self, console: Console) -> None:
        """Reads, integrates, adds noise and writes."""
        from difftetvr.capture import Noise, ProjectionCapture, ProjectionGeometry, project_volume
        from difftetvr.capture.projections.scan_file import require_scan_format

        require_scan_format(self.output)
        require_writable(self.output, CaptureError)
        noise = Noise() if self.noise is None else Noise.parse(self.noise)
        noise.require_seed(self.seed)
        geometry = ProjectionGeometry.load(self.geometry)
        test = ProjectionCapture.held_out(self.holdout_every, geometry.num_views)
        volume = self._read(console)
        self._say_proportions(console, volume, geometry)
        with counting(console, f"Projecting {self.volume.name}", "view") as progress:
            clean = project_volume(volume.values, geometry, self.method, device=self.device, progress=progress)
        if not bool(clean.any()):
            console.print(f"No ray meets anything of {self.volume}: all line integrals are 0.", highlight=False)
        noisy = noise.apply(clean, self.seed)
        valid = None if bool(noisy.valid.all()) else noisy.valid
        capture = ProjectionCapture(
            geometry, noisy.line_integrals, noisy.variance, valid, test, self.volume.name.split(".")[0]
        )
        with waiting(console, f"Writing {self.output}"):
            capture.save(self.output)
        views, height, width = geometry.shape
        parts = [
            f"{counted(views, 'view')} of {width} x {height} pixels",
            f"line integrals up to {float(clean.max()):.4g}",
        ]
        if noise.poisson is not None:
            deviation = float((noisy.line_integrals - clean).square().mean(dtype=clean.double().dtype).sqrt())
            parts.append(f"noise of {deviation:.3g} in the root mean square")
        if valid is not None:
            parts.append(f"{counted(int((~valid).sum()), 'pixel')} without a count")
        console.print(f"Wrote {self.output} ({', '.join(parts)})", highlight=False)

    def _read(self, console: Console) -> VoxelVolume:
        from difftetvr.capture import load_volume

        options = saying(console, lambda said: said.replace("value_range says", "--value-range says"))
        with options, waiting(console, f"Reading {self.volume}"):
            return load_volume(self.volume, self.shape, self.dtype, self.value_range)

    def _say_proportions(self, console: Console, volume: VoxelVolume, geometry: ProjectionGeometry) -> None:
        """Prints a line where voxels are stretched, since all of them fill the box of the geometry."""
        box = (geometry.bounds[1] - geometry.bounds[0]).tolist()
        ratios = [side / own for side, own in zip(box, volume.extent)]
        if max(ratios) > (1 + _SAME_SHAPE) * min(ratios):
            own, given = (" x ".join(f"{side:.4g}" for side in sides) for sides in (volume.extent, box))
            console.print(
                f"The voxels of {self.volume}, whose box is {own} by their file, are stretched to {given}, the box of "
                f"{self.geometry}.",
                highlight=False,
            )
