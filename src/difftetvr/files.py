"""Writing files so that an interrupted or failed save never leaves half a file behind."""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from difftetvr.errors import DiffTetError

_ADVICE = {
    errno.EACCES: "choose a folder you may write to",
    errno.EDQUOT: "free some of your quota or choose another disk",
    errno.EFBIG: "raise the limit on the size of files or choose another disk",
    errno.EINVAL: "choose the name of an ordinary file",
    errno.EISDIR: "choose the name of a file, not of a folder",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.ENOENT: "create the folder first",
    errno.ENOSPC: "free some space or choose another disk",
    errno.ENOTDIR: "choose a path that does not run through a file",
    errno.EPERM: "choose a folder you may write to",
    errno.EROFS: "choose a disk that is not read-only",
}
_OTHER_ADVICE = "check the disk or choose another folder"


@contextmanager
def atomic_write(
    path: str | os.PathLike[str], error: type[DiffTetError] = DiffTetError, *, fsync: bool = False
) -> Iterator[Path]:
    """Context manager for a file that appears at its place complete or not at all.

    The body writes to a new, empty file in the folder of ``path``, with the same suffix. When the body ends, that file
    replaces ``path`` in one step; when it raises (``KeyboardInterrupt`` included), that file is removed and ``path``
    stays as it was.

    Args:
        path: The file to write. Its folder must exist. A symbolic link is followed: the file it points to is replaced.
        error: The exception that an ``OSError`` is turned into, inside the body too.
        fsync: Force the data onto the disk before the file takes its place, so that it survives a power cut.

    Yields:
        Path of the temporary file.

    Raises:
        DiffTetError: (of type ``error``) The file cannot be written: no folder, no permission, full disk...

    Example:
        >>> with atomic_write("model.bin", MeshError) as temporary:
        ...     temporary.write_bytes(data)
    """
    target = Path(os.path.realpath(path))
    temporary = target.with_name(f".{target.stem[:40]}-{secrets.token_hex(4)}{target.suffix}")
    try:
        mode = _replaceable_mode(target)
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        yield temporary
        if fsync:
            _flush_to_disk(temporary)
        if mode is not None:
            os.chmod(temporary, mode)
        os.replace(temporary, target)
    except OSError as problem:
        raise error(_sentence(path, problem)) from problem
    finally:
        # After a successful replace there is nothing left to remove.
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def _flush_to_disk(path: Path) -> None:
    with path.open("rb+") as file:
        os.fsync(file.fileno())


def _replaceable_mode(target: Path) -> int | None:
    """Permissions of the file that will be replaced, None if there is none yet; folders and devices stay untouched."""
    try:
        status = target.stat()
    except FileNotFoundError:
        return None
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "Not a regular file")
    return stat.S_IMODE(status.st_mode)


def _sentence(path: str | os.PathLike[str], problem: OSError) -> str:
    reason = (problem.strerror or str(problem) or type(problem).__name__).rstrip(".")
    advice = _ADVICE.get(problem.errno or 0, _OTHER_ADVICE)
    return f"Cannot write {os.fspath(path)}: {reason[:1].lower()}{reason[1:]}; {advice}."
