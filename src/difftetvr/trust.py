"""How far files are trusted that come from strangers: where they may lead, and how much memory they may take.

Every reader asks here; `trusting` is how a caller who knows better says so.
"""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path

from difftetvr.errors import DiffTetError

UNPACKED_BYTES = 2**30
"""What compressed data may take when unpacked without further ado, where the file is not large itself."""

_USUAL_RATIO = 20
_SHARE_OF_FREE_MEMORY = 0.8
_SHORTEST_PRINTED = 80


@dataclass(frozen=True)
class Trust:
    """What a caller allows.

    Attributes:
        outside: Folder below which files may lie that another file names, besides the folder of that file; None: none.
        large: Whether data may be unpacked to any size that fits the memory.
    """

    outside: Path | None = None
    large: bool = False


# What a caller allows holds for all that it calls, and for no one else: the readers in between need not hand it on.
_TRUST: ContextVar[Trust | None] = ContextVar("trust", default=None)


@contextlib.contextmanager
def trusting(outside: str | Path | None = None, large: bool = False) -> Iterator[None]:
    """Context in which files are trusted further than usual.

    Args:
        outside: Folder below which files may lie that another file names: images, masks, pieces, arrays. Without it
            these must lie in the folder of the file that names them, or below it, after all links are resolved.
        large: Whether compressed data may become larger than 1 GiB and 20 times the file, as long as memory is free.

    Raises:
        DiffTetError: ``outside`` is no folder.

    Example:
        >>> with dtv.trusting(outside="/data", large=True):
        ...     capture = dtv.load_capture("/data/captures/lego")
    """
    root = None
    if outside is not None:
        root = Path(os.path.realpath(outside))
        if not root.is_dir():
            raise DiffTetError(f"There is no folder {outside} below which files could lie; check the path.")
    token = _TRUST.set(Trust(root, large))
    try:
        yield
    finally:
        _TRUST.reset(token)


def file_beside(owner: Path, name: str | os.PathLike[str], error: type[DiffTetError]) -> Path:
    """Where a file lies that another file names; it need not exist.

    Args:
        owner: The file that names it, or a folder whose content belongs together.
        name: Path as written, relative to the owner's folder or absolute; with either kind of slash.
        error: The exception to raise.

    Returns:
        The path, with the owner's folder in front of it where it is relative.

    Raises:
        DiffTetError: (of type ``error``) It lies outside of the owner's folder and of what `trusting` allows.
    """
    folder = owner if owner.is_dir() else owner.parent
    text = os.fspath(name)
    if os.sep == "/":
        text = text.replace("\\", "/")
    path = folder / text
    try:
        target = Path(os.path.realpath(path))
    except (OSError, ValueError) as problem:  # a null character, a circle of links
        raise error(f"{owner} names the file {_shortened(text)!r}, which is no path; correct it.") from problem
    roots = [Path(os.path.realpath(folder))]
    if (outside := current_trust().outside) is not None:
        roots.append(outside)
    if not any(target.is_relative_to(root) for root in roots):
        raise error(
            f"{owner} names the file {_shortened(text)!r}, which lies outside of its folder; move it there, or allow "
            "a folder that holds both with --allow-outside (in Python: with dtv.trusting(outside=...))."
        )
    return path


def require_regular(path: Path, error: type[DiffTetError]) -> None:
    """Refuses what is there but no ordinary file: pipes and devices, which may never end, and folders.

    Raises:
        DiffTetError: (of type ``error``) It is no ordinary file. What is not there is for the reader to say.
    """
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        return
    if not stat.S_ISREG(mode):
        what = "a folder" if stat.S_ISDIR(mode) else "a pipe or a device"
        raise error(f"Cannot read {path}: it is {what}, not a file; give the path of an ordinary file.")


def require_modest(path: Path, size: int, what: str, error: type[DiffTetError]) -> int:
    """Holds the size that compressed data have, or say they have, against the limit and the free memory.

    Args:
        path: The file they come from.
        size: Bytes, of all that is unpacked of this file together.
        what: What they are, for the sentence.
        error: The exception to raise.

    Returns:
        The largest size that is allowed; a reader that does not know the size stops there.

    Raises:
        DiffTetError: (of type ``error``) It is too large.
    """
    free = int(_SHARE_OF_FREE_MEMORY * free_memory())
    if size > free:
        raise error(
            f"{path} holds {what} of {_bytes(size)}, but only {_bytes(free)} of memory can be used; make them smaller "
            "or use a machine with more."
        )
    if current_trust().large:
        return free
    try:
        packed = os.path.getsize(path)
    except OSError:
        packed = 0
    most = min(max(UNPACKED_BYTES, _USUAL_RATIO * packed), free)
    if size > most:
        raise error(
            f"{path} ({_bytes(packed)}) holds {what} that unpack to more than {_bytes(most)}; if you trust it, allow "
            "that with --allow-large (in Python: with dtv.trusting(large=True))."
        )
    return most


def require_free(size: int, what: str, advice: str, error: type[DiffTetError], free: int | None = None) -> None:
    """Checks that there is memory for something before it is made.

    Args:
        size: Bytes, roughly.
        what: What takes them, at the beginning of the sentence.
        advice: What to do where it does not fit.
        error: The exception to raise.
        free: Bytes that are there; default: those of the memory.

    Raises:
        DiffTetError: (of type ``error``) There is not.
    """
    free = int(_SHARE_OF_FREE_MEMORY * (free_memory() if free is None else free))
    if size > free:
        raise error(f"{what} would take {_bytes(size)}, but only {_bytes(free)} of memory can be used; {advice}.")


def current_trust() -> Trust:
    """What the caller allows; for readers that run in a process of their own and have to be told there."""
    return _TRUST.get() or Trust()


def free_memory() -> int:
    """Bytes of memory that this process may still take, as far as the system says; a very large number where not."""
    free = 2**62
    with contextlib.suppress(OSError, ValueError, IndexError):
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                free = 1024 * int(line.split()[1])
    with contextlib.suppress(OSError, ValueError):
        most = Path("/sys/fs/cgroup/memory.max").read_text(encoding="ascii").strip()
        used = Path("/sys/fs/cgroup/memory.current").read_text(encoding="ascii").strip()
        if most.isdigit():
            free = min(free, max(int(most) - int(used), 0))
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource  # not on Windows

        limit, _ = resource.getrlimit(resource.RLIMIT_AS)
        if limit != resource.RLIM_INFINITY:
            pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
            free = min(free, max(limit - pages * resource.getpagesize(), 0))
    return free


def _shortened(text: str) -> str:
    return text if len(text) <= _SHORTEST_PRINTED else f"...{text[-_SHORTEST_PRINTED:]}"


def _bytes(count: int) -> str:
    if count >= 2**70:  # of any size, also such as no float holds
        return "more than 1024 EiB"
    for unit, size in (("TiB", 2**40), ("GiB", 2**30), ("MiB", 2**20), ("KiB", 2**10)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count} bytes"
