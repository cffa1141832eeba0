"""Films: frames one after the other, as a video, an animated picture, or a folder of pictures."""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from difftetvr.errors import CaptureError
from difftetvr.files import atomic_write, require_writable, require_writable_folder

VIDEOS = (".mp4", ".webm")
ANIMATIONS = (".webp", ".gif")
_CODECS = {".mp4": ("libx264", ["-crf", "10"]), ".webm": ("libvpx-vp9", ["-crf", "18", "-b:v", "0"])}
"""Encoder of each kind of video, and how good it is to be."""

_BT709 = [
    *("-vf", "scale=in_range=full:out_range=limited:out_color_matrix=bt709"),
    *("-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709", "-color_range", "tv"),
]
"""Which red, green and blue a video means: players guess by its size where it does not say so."""

_LEAST_SIDE = 2  # pixels of a video
_GIF_TICK = 10  # milliseconds in which a .gif counts
_LEAST_SHOWN = 20  # milliseconds; browsers take shorter ones for ten times as long


def is_film(path: Path) -> bool:
    """Whether a file of this name holds a film: .mp4, .webm, .webp, .gif, or a folder, whose name has no ending."""
    return path.suffix.lower() in (*VIDEOS, *ANIMATIONS, "")


def require_film(path: Path) -> None:
    """Checks where a film is to go, and what writes it, before the time to render it is spent.

    Raises:
        CaptureError: The name says no kind of film, a package is missing, or nothing can be written there.
    """
    if not is_film(path):
        raise CaptureError(
            f"A film is written as .mp4, .webm, .webp or .gif, or as a folder of pictures, which {path} is none of; "
            "rename it."
        )
    if path.suffix:
        require_writable(path, CaptureError)
    else:
        require_writable_folder(path.parent, CaptureError)
        if path.exists() and not (path.is_dir() and not any(path.iterdir())):
            raise CaptureError(f"{path} is there already; choose another name for the folder of pictures.")
    if path.suffix.lower() in VIDEOS:
        _encoder()


def require_shown(path: Path, size: tuple[int, int], fps: float, is_transparent: bool) -> None:
    """Checks that a film can be what is asked for, before the time to render it is spent.

    Args:
        path: The film.
        size: Width and height in pixels.
        fps: Frames a second.
        is_transparent: Whether one is to see through it.

    Raises:
        CaptureError: Films of that kind cannot.
    """
    kind = path.suffix.lower()
    if is_transparent and kind in (*VIDEOS, ".gif"):
        raise CaptureError(
            f"A {kind} knows no shades of transparency; choose a .webp, a folder of pictures, or a background."
        )
    if kind in VIDEOS and min(size) < _LEAST_SIDE:
        raise CaptureError(f"A {kind} of {size[0]} x {size[1]} pixels is too small; both sides must have 2 or more.")
    if kind in ANIMATIONS and 1000.0 / fps < _LEAST_SHOWN:
        most = 1000 // _LEAST_SHOWN
        raise CaptureError(f"Browsers show a {kind} with at most {most} frames a second; take fewer, or make an .mp4.")


def save_film(path: str | Path, frames: Iterable[Image.Image], fps: float) -> int:
    """Writes a film as its frames come, whole or not at all.

    Args:
        path: The file: ``.mp4`` (H.264) or ``.webm`` (VP9), which the extra ``film`` writes; ``.webp`` or ``.gif``,
            animated and endless; or a name without an ending, a folder of PNG files that is not there yet.
        frames: Pictures of one size. An odd width or height loses a pixel in a video; one sees through those that are
            transparent in a ``.webp`` or a folder alone.
        fps: Frames a second, > 0; of ``.webp`` and ``.gif`` at most 50.

    Returns:
        The number of frames.

    Raises:
        CaptureError: The film cannot be written, films of that kind do not look so, or there is no frame.
    """
    path = Path(path)
    require_film(path)
    frames = _checked(frames, path, fps)
    if path.suffix.lower() in VIDEOS:
        with atomic_write(path, CaptureError) as temporary:
            return _encode(temporary, frames, fps)
    with _folder_of(path, frames) as (folder, count):
        if path.suffix:
            with atomic_write(path, CaptureError) as temporary:
                _animate(temporary, sorted(folder.iterdir()), fps)
        else:
            if path.exists():
                path.rmdir()  # An empty one, as was made sure of.
            os.rename(folder, path)
    return count


@contextlib.contextmanager
def _folder_of(path: Path, frames: Iterable[Image.Image]) -> Iterator[tuple[Path, int]]:
    """Context with a folder of the frames beside the film to be, and their number; it goes, unless it is renamed."""
    folder = None
    try:
        folder = Path(tempfile.mkdtemp(prefix=f".{path.stem[:40]}-", dir=path.absolute().parent))
        folder.chmod(0o777 & ~_umask())
        count = 0
        for frame in frames:
            frame.save(folder / f"{count:05d}.png")
            count += 1
        _require_frame(count, path)
        yield folder, count
    except OSError as problem:
        reason = (problem.strerror or str(problem)).rstrip(".").lower()
        room = "free some space" if problem.errno == errno.ENOSPC else "choose another folder"
        raise CaptureError(f"Cannot write {path}: {reason}; {room}.") from problem
    finally:
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)


def _umask() -> int:
    """Which permissions new files do not get; there is no way to ask but to set it."""
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _checked(frames: Iterable[Image.Image], path: Path, fps: float) -> Iterator[Image.Image]:
    """The frames; an error at the first one where films of the kind cannot show such."""
    for index, frame in enumerate(frames):
        if index == 0:
            require_shown(path, frame.size, fps, frame.mode == "RGBA")
        yield frame


def _animate(path: Path, files: list[Path], fps: float) -> None:
    """Writes an animated picture; each file is read when its frame is written."""
    first, *others = (Image.open(file) for file in files)
    is_gif = path.suffix.lower() == ".gif"
    options: dict[str, Any] = {"disposal": 2} if is_gif else {"quality": 90, "method": 4}
    durations = _durations(len(files), fps, _GIF_TICK if is_gif else 1)
    first.save(path, save_all=True, append_images=others, duration=durations, loop=0, **options)


def _durations(count: int, fps: float, tick: int) -> list[int]:
    """Milliseconds that each frame is shown, multiples of a tick; all together take as long as they should."""
    ends = [round(index * 1000.0 / (fps * tick)) for index in range(count + 1)]
    return [tick * (end - begin) for begin, end in itertools.pairwise(ends)]


def _encode(path: Path, frames: Iterable[Image.Image], fps: float) -> int:
    """Writes a video.

    Raises:
        OSError: The encoder could not write all of it; the disk knows why.
    """
    encoder, count = None, 0
    codec, quality = _CODECS[path.suffix.lower()]
    try:
        for frame in frames:
            size = (frame.width // 2 * 2, frame.height // 2 * 2)
            if encoder is None:
                encoder = _encoder().write_frames(
                    str(path),
                    size,
                    fps=fps,
                    codec=codec,
                    quality=None,
                    macro_block_size=2,
                    ffmpeg_log_level="fatal",
                    ffmpeg_timeout=0,
                    output_params=[*quality, *_BT709],
                )
                encoder.send(None)
            try:
                encoder.send(np.ascontiguousarray(frame.convert("RGB").crop((0, 0, *size))))
            except OSError as problem:
                raise OSError("the encoder has stopped") from problem
            count += 1
    finally:
        if encoder is not None:
            encoder.close()
    _require_frame(count, path)
    _require_whole(path, count)
    return count


def _require_whole(path: Path, count: int) -> None:
    """Reads a video again: an encoder that fails at its end says so to nobody.

    Raises:
        OSError: It has not all of its frames.
    """
    try:
        found, _ = _encoder().count_frames_and_secs(str(path))
    except (RuntimeError, OSError):
        found = 0
    if found != count:
        raise OSError(f"the encoder wrote {found} of {count} frames")


def _require_frame(count: int, path: Path) -> None:
    if count == 0:
        raise CaptureError(f"The film {path} has no frames; give one or more.")


def _encoder() -> Any:
    """The package that writes videos.

    Raises:
        CaptureError: It is not installed.
    """
    try:
        import imageio_ffmpeg
    except ImportError:
        raise CaptureError(
            "Videos are written by imageio-ffmpeg, which is not installed; pip install 'difftetvr[film]', or write a "
            ".webp, a .gif or a folder of pictures."
        ) from None
    return imageio_ffmpeg
