"""Options of what scalars look like, of simulations and of volumes."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from difftetvr.errors import CaptureError, MeshError

if TYPE_CHECKING:
    from difftetvr.capture import Volume
    from difftetvr.mesh import Field, TetMesh
    from difftetvr.mesh.io import MeshData
    from difftetvr.mesh.io.scalars import Scalar
    from difftetvr.optics.transfer_function import TransferFunction
    from difftetvr.rendering import ScalarField
    from difftetvr.view.frames import ColorScale
    from difftetvr.view.looks import Distribution, Look
    from difftetvr.view.looks.opacities import OpacityPreset

COLOR_GROUP = ("scalar", "transfer-function", "colormap", "value-range", "percentile", "log")
"""Names of the options of colours below."""

SCALAR_GROUP = (
    *("scalar", "transfer-function", "colormap", "opacity", "value-range", "percentile", "log", "attenuation"),
)
"""Names of all options below."""

_LEAST_KEPT, _MOST_KEPT = 1e-120, 1e120
_ATTENUATION = 25.0  # of a transfer function from a file, as in the published experiments


@dataclass(frozen=True)
class ColorOptions:
    """Which colours scalars have, for meshes without color and density, where a scalar is named, and for volumes."""

    scalar: str | None = None
    """Name of the point or cell data to show, with a component if wanted (velocity:x, stress:von-mises); default: color
    and density, or the only data there are."""
    transfer_function: Path | None = None
    """Colour and opacity of the scalar, .json or .xml; default: what the following options say."""
    colormap: str | None = None
    """Name of a colour map of Matplotlib's or cmcrameri's, such as viridis, turbo or batlow; default: coolwarm."""
    value_range: tuple[float, float] | None = None
    """Scalars at the transfer function's 0 and 1; default: the least and the greatest, but for outliers."""
    percentile: tuple[float, float] | None = None
    """The same, as per cent of the volume with smaller scalars, such as 1 99."""
    log: bool = False
    """Spread the colours over the logarithm of the scalar."""

    def given(self) -> list[str]:
        """Names of the options of what a scalar looks like that are given."""
        values = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "scalar"}
        return [name.replace("_", "-") for name, value in values.items() if value is not None and value is not False]

    def _opacity(self) -> OpacityPreset | None:
        return None

    def _attenuation(self) -> float | None:
        return None

    def apply(self, data: MeshData, path: Path) -> Shown:
        """What to render of a file.

        Raises:
            MeshError: There is no such scalar, it is the same everywhere, an option is out of range, or one is given
                for what has its own colours.
            CaptureError: There is no such transfer function or colour map.
        """
        if self.scalar is None and data.field is not None:
            if given := self.given():
                raise MeshError(
                    f"--{given[0]} is for scalars, but {path} has color and density; name a scalar by --scalar, or "
                    "leave it out."
                )
            return Shown(data.mesh, data.field)
        import torch

        from difftetvr.mesh.io import missing_note, scalar_of
        from difftetvr.rendering import ScalarField

        self._require_valid()
        try:
            scalar = scalar_of(data, self.scalar)
        except MeshError as error:
            raise MeshError(f"{path}: {error}") from error
        low, high = (float(v) for v in torch.aminmax(scalar.values))
        if low == high and self.value_range is None:
            value = low + scalar.offset
            raise MeshError(
                f"The scalar '{scalar.name}' of {path} is {value:g} everywhere; name another, or give --value-range."
            )
        value_range = self._range_from_offset(scalar)
        lower, upper = data.mesh.bounds()
        longest = float((upper - lower).max())
        if self.transfer_function is not None:
            function, density = self._loaded(self.transfer_function)
            field = ScalarField(scalar.values, function, density / longest, value_range, scalar.location)
            scale = _scale(scalar, function, value_range or (low, high), None)
        else:
            look = self._look_of(scalar, value_range)
            density = self._density(look.attenuation)
            function = look.transfer_function
            field = ScalarField(scalar.values, function, density / longest, look.value_range, scalar.location)
            scale = _scale(scalar, function, look.value_range, look)
        return Shown(scalar.mesh, field, scalar.name, missing_note(scalar), scale, density)

    def apply_to_volume(self, volume: Volume, function: TransferFunction | None) -> ShownVolume:
        """What to render of a volume.

        Args:
            volume: The volume.
            function: A transfer function of its scalars; None: made by the options, as it is where these say anything
                of it but name its file.

        Raises:
            MeshError: An option is out of range, or the values leave no range.
            CaptureError: There is no such colour map.
        """
        import numpy as np

        from difftetvr.view.frames import ColorScale
        from difftetvr.view.looks import Distribution

        self._require_valid()
        low, high = (float(end) for end in volume.value_range)
        says_looks = not {"colormap", "opacity", "percentile", "log"}.isdisjoint(self.given())
        if function is not None and not says_looks:
            density = self._density(_ATTENUATION)
            return ShownVolume(volume, function, density, ColorScale("value", (low, high), function))
        # In the values of the file, of which logarithms are to be taken; but for a factor, so that nothing overflows.
        unit = _unit_of(low, high)
        low, high = unit * low, unit * high
        found = Distribution.of_volume(volume)
        ends = (low + (high - low) * found.ends[0], low + (high - low) * found.ends[1])
        in_file = replace(
            found, values=low + (high - low) * found.values, slopes=(high - low) * found.slopes, ends=ends
        )
        look = self._look(in_file, self.value_range, volume.name, unit)
        start, end = ((unit * value - low) / (high - low) for value in look.value_range)
        values = ((volume.values - start) / (end - start)).clip(0.0, 1.0).astype(np.float32)
        shown = replace(volume, values=values, value_range=look.value_range)
        density = self._density(look.attenuation)
        scale = ColorScale("value", look.value_range, look.transfer_function, look.is_log)
        return ShownVolume(shown, look.transfer_function, density, scale)

    def _range_from_offset(self, scalar: Scalar) -> tuple[float, float] | None:
        """The range that is given, in the numbers that stand for a scalar."""
        if self.value_range is None:
            return None
        low, high = (scalar.counted_from_offset(value) for value in self.value_range)
        return low, high

    def _look_of(self, scalar: Scalar, value_range: tuple[float, float] | None) -> Look:
        """The look of a scalar of a mesh."""
        from difftetvr.view.looks import Distribution

        unit = _unit_of(float(scalar.values.min()), float(scalar.values.max()))
        distribution = Distribution.of_scalars(scalar.mesh, unit * scalar.values.double(), scalar.location)
        return self._look(distribution, value_range, scalar.name, unit)

    def _look(
        self, distribution: Distribution, value_range: tuple[float, float] | None, name: str, unit: float
    ) -> Look:
        """The look of a scalar whose values are those of the distribution divided by a unit, as its range is."""
        from difftetvr.view.looks import Appearance

        value_range = None if value_range is None else (unit * value_range[0], unit * value_range[1])
        usual = Appearance()
        appearance = Appearance(
            self.colormap or usual.colormap, self._opacity() or usual.opacity, value_range, self.percentile, self.log
        )
        look = appearance.look(distribution, name)
        low, high = look.value_range
        return replace(look, value_range=(low / unit, high / unit))

    def _loaded(self, path: Path) -> tuple[TransferFunction, float]:
        from difftetvr.optics.transfer_function import TransferFunction

        return TransferFunction.load(path), self._density(_ATTENUATION)

    def _density(self, usual: float) -> float:
        given = self._attenuation()
        return usual if given is None else given

    def _require_valid(self) -> None:
        if self.transfer_function is not None:
            other = {"colormap": self.colormap, "opacity": self._opacity(), "percentile": self.percentile}
            given = [name for name, value in other.items() if value is not None] + ["log"] * self.log
            if given:
                raise CaptureError(
                    f"The transfer function {self.transfer_function} says what the scalar looks like; leave out "
                    f"--{given[0]}, or --transfer-function."
                )
        if self.percentile is not None:
            low, high = self.percentile
            if not 0.0 <= low < high <= 100.0:
                raise MeshError(f"--percentile is {low:g} {high:g}; give two numbers from 0 to 100, the smaller first.")
            if self.value_range is not None:
                raise MeshError("--value-range and --percentile both say where the colours end; leave out one of them.")


@dataclass(frozen=True)
class ScalarOptions(ColorOptions):
    """What scalars look like: their colours, and how opaque they are."""

    opacity: Literal["edges", "peak", "ramp", "flat"] | None = None
    """Opaque is where the scalar changes, or only near some values, as surfaces; the more the greater it is; or
    everything alike; default: edges."""
    attenuation: float | None = None
    """Density of opacity 1, where the mesh's longest side is 1; default: so that one sees through, with a transfer
    function 25."""

    def _opacity(self) -> OpacityPreset | None:
        return self.opacity

    def _attenuation(self) -> float | None:
        return self.attenuation

    def _require_valid(self) -> None:
        if self.attenuation is not None and not (math.isfinite(self.attenuation) and self.attenuation >= 0):
            raise MeshError(f"--attenuation is {self.attenuation:g}; it must be finite and not negative.")
        super()._require_valid()


@dataclass(frozen=True)
class Shown:
    """What is rendered: a mesh, what it holds, and of scalars more.

    Attributes:
        mesh: The mesh.
        field: What it holds.
        name: Of the scalar; None: color and density.
        note: What to say of it.
        scale: Its colours.
        density: Density of opacity 1, where the longest side is 1.
    """

    mesh: TetMesh
    field: Field | ScalarField
    name: str | None = None
    note: str | None = None
    scale: ColorScale | None = None
    density: float = 0.0


@dataclass(frozen=True)
class ShownVolume:
    """A volume, the transfer function of its scalars, the density of opacity 1, and its colours."""

    volume: Volume
    function: TransferFunction
    density: float
    scale: ColorScale


def _unit_of(low: float, high: float) -> float:
    """A power of two that brings numbers into the range in which squares, differences and sums of them are numbers."""
    largest = max(abs(low), abs(high))
    if _LEAST_KEPT < largest < _MOST_KEPT or largest == 0.0:
        return 1.0
    return 2.0 ** -min(max(math.frexp(largest)[1], -1000), 1020)


def _scale(
    scalar: Scalar, function: TransferFunction, value_range: tuple[float, float], look: Look | None
) -> ColorScale:
    from difftetvr.view.frames import ColorScale

    ends = (value_range[0] + scalar.offset, value_range[1] + scalar.offset)
    if look is None:
        return ColorScale(scalar.name, ends, function)
    return ColorScale(scalar.name, ends, function, look.is_log)
