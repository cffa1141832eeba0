"""Where images come from: volumes with transfer functions, saved captures, camera orbits."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

from difftetvr.capture.capture import Capture
from difftetvr.capture.orbit import fibonacci_orbit, random_orbit
from difftetvr.capture.volume import Volume, is_volume_file
from difftetvr.capture.volume_capture import TOOTH, VolumeCapture
from difftetvr.capture.volume_renderer import VolumeRenderer
from difftetvr.errors import CaptureError
from difftetvr.optics.transfer_function import TransferFunction

__all__ = [
    "Capture",
    "TransferFunction",
    "Volume",
    "VolumeCapture",
    "VolumeRenderer",
    "fibonacci_orbit",
    "load_capture",
    "random_orbit",
]


def load_capture(source: str | Path, **overrides: Any) -> Capture:
    """Images and cameras from whatever ``source`` is.

    Args:
        source: ``tooth`` for the packaged scan, a volume file (``.raw``, ``.dat``, ``.nrrd``, ``.nhdr``, ``.vti``),
            or a capture saved as ``.npz``.
        **overrides: Fields of :class:`VolumeCapture` for the tooth and for volumes; a volume needs at least
            ``transfer_function``. None stands for the field's default.

    Raises:
        CaptureError: The source or an override is not known or not valid.
    """
    chosen = {key: value for key, value in overrides.items() if value is not None}
    known = {field.name for field in fields(VolumeCapture)} - {"path"}
    unknown = sorted(set(chosen) - known)
    if unknown:
        raise CaptureError(f"A capture has no setting '{unknown[0]}'; known are {', '.join(sorted(known))}.")
    if str(source) == TOOTH or is_volume_file(source):
        return VolumeCapture(path=str(source), **chosen).build()
    if Path(source).suffix.lower() != ".npz":
        raise CaptureError(
            f"'{source}' is no capture: give 'tooth', a volume (.raw, .dat, .nrrd, .nhdr, .vti) or a saved capture "
            "(.npz)."
        )
    if chosen:
        raise CaptureError(f"The saved capture '{source}' is read as it is; leave out '{sorted(chosen)[0]}'.")
    return Capture.load(source)
