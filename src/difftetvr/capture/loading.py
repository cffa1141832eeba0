"""Captures from whatever a user names: the packaged scan, volumes, photographs, saved captures."""

from __future__ import annotations

from dataclasses import fields
from os import PathLike
from pathlib import Path
from typing import Any

from difftetvr.capture.camera_set import CameraSet
from difftetvr.capture.capture import Capture
from difftetvr.capture.photos.photo_capture import PhotoCapture, is_photo_source
from difftetvr.capture.photos.readers.foreign import known_export
from difftetvr.capture.volumes.readers.table import KNOWN, is_volume_file
from difftetvr.capture.volumes.volume_capture import TOOTH, VolumeCapture
from difftetvr.errors import CaptureError
from difftetvr.inputs import require_type


def load_capture(source: str | Path, **overrides: Any) -> Capture:
    """Images and cameras from whatever ``source`` is.

    Args:
        source: ``tooth`` for the packaged scan, a volume that `Volume.load` reads, a capture saved as ``.npz``,
            or photographs with known cameras: a folder (NeRF-synthetic, nerfstudio, instant-ngp, COLMAP, Polycam,
            Record3D, or with a cameras.json of our own), such a ``.json`` file, or a tiny NeRF ``.npz``.
        **overrides: Fields of :class:`VolumeCapture` for the tooth and for volumes; a volume needs at least
            ``transfer_function``. Fields of :class:`PhotoCapture` for photographs. None stands for the field's default.

    Raises:
        CaptureError: The source or an override is not known or not valid.
    """
    require_type(source, (str, PathLike), "The source", "pass the path of a capture, or 'tooth'", CaptureError)
    description = _description(source, overrides)
    return Capture.load(source) if description is None else description.build()


def load_cameras(source: str | Path, **overrides: Any) -> CameraSet:
    """The cameras of a capture, without its images: neither are photographs decoded nor volumes read or rendered.

    Args:
        source: As for :func:`difftetvr.load_capture`.
        **overrides: Likewise; all of them may be given, whether or not cameras depend on them.

    Raises:
        CaptureError: The source or an override is not known or not valid.
    """
    require_type(source, (str, PathLike), "The source", "pass the path of a capture, or 'tooth'", CaptureError)
    description = _description(source, overrides)
    if description is not None:
        return description.camera_set()
    capture = Capture.load(source)
    return CameraSet(capture.cameras, capture.test, capture.name)


def _description(source: str | Path, overrides: dict[str, Any]) -> VolumeCapture | PhotoCapture | None:
    """What says how a source is read; None for a saved capture, which is read as it is."""
    chosen = {key: value for key, value in overrides.items() if value is not None}
    kind = _kind(source, chosen)
    if kind is None:
        if chosen:
            raise CaptureError(f"The saved capture '{source}' is read as it is; leave out '{sorted(chosen)[0]}'.")
        return None
    known = {field.name for field in fields(kind)} - {"path"}
    unknown = sorted(set(chosen) - known)
    if unknown:
        what = "A capture of photos" if kind is PhotoCapture else "A capture of a volume"
        raise CaptureError(f"{what} has no setting '{unknown[0]}'; known are {', '.join(sorted(known))}.")
    return kind(path=str(source), **chosen)


def _kind(source: str | Path, chosen: dict[str, Any]) -> type[VolumeCapture | PhotoCapture] | None:
    """What describes a source; None for a saved capture, which describes itself."""
    if str(source) == TOOTH or is_volume_file(source):
        return VolumeCapture
    if "format" in chosen or is_photo_source(source):
        return PhotoCapture
    if Path(source).suffix.lower() == ".npz":
        return None
    if (export := known_export(Path(source))) is not None:
        raise CaptureError(f"'{source}' {export}.")
    raise CaptureError(
        f"'{source}' is no capture: give 'tooth', a volume ({KNOWN}), a saved capture (.npz), or a folder of photos "
        "with their cameras."
    )
