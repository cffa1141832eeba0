"""Films: frames one after the other, as a video, an animated picture, or a folder of pictures."""

from __future__ import annotations

import contextlib
import errno
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
_CODECS = {".mp4": "libx264", ".webm": "libvpx-vp9"}
_QUALITY = 8  # of imageio-ffmpeg's 10


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


def save_film(path: str | Path, frames: Iterable[Image.Image], fps: float) -> int:
    """Writes a film as its frames come, whole or not at all.

    Args:
        path: The file: ``.mp4`` (H.264) or ``.webm`` (VP9), which the extra ``film`` writes; ``.webp`` or ``.gif``,
            animated and endless; or a name without an ending, a folder of PNG files that is not there yet.
        frames: Pictures of one size. Videos have no transparency, and an odd width or height loses a pixel there.
        fps: Frames a second, > 0.

    Returns:
        The number of frames.

    Raises:
        CaptureError: The film cannot be written, or there is no frame.
    """
    path = Path(path)
    require_film(path)
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


def _animate(path: Path, files: list[Path], fps: float) -> None:
    """Writes an animated picture; each file is read when its frame is written."""
    first, *others = (Image.open(file) for file in files)
    options: dict[str, Any] = {"quality": 90, "method": 4} if path.suffix.lower() == ".webp" else {"disposal": 2}
    first.save(path, save_all=True, append_images=others, duration=round(1000.0 / fps), loop=0, **options)


def _encode(path: Path, frames: Iterable[Image.Image], fps: float) -> int:
    """Writes a video."""
    encoder, count = None, 0
    try:
        for frame in frames:
            size = (frame.width // 2 * 2, frame.height // 2 * 2)
            if encoder is None:
                encoder = _encoder().write_frames(
                    str(path), size, fps=fps, codec=_CODECS[path.suffix.lower()], quality=_QUALITY, macro_block_size=2
                )
                encoder.send(None)
            encoder.send(np.ascontiguousarray(frame.convert("RGB").crop((0, 0, *size))))
            count += 1
    finally:
        if encoder is not None:
            encoder.close()
    _require_frame(count, path)
    return count


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
