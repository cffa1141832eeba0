"""Writing files so that a failed save leaves no half a file behind, one that was killed is swept, and none meet."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import secrets
import shutil
import stat
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from difftetvr.errors import DiffTetError

if sys.platform != "win32":
    import fcntl

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
_PROBE_BYTES = 2**20
_STEM_LENGTH = 40
_NO_LOCKS_HERE = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
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
    temporary = _temporary_name(target)
    try:
        mode = _replaceable_mode(target)
        with contextlib.ExitStack() as life:
            life.enter_context(_created(temporary))
            yield temporary
            if fsync:
                _flush_to_disk(temporary)
            if mode is not None:
                os.chmod(temporary, mode)
            if sys.platform == "win32":
                life.close()  # There an open file cannot be renamed.
            os.replace(temporary, target)
    except OSError as problem:
        # Libraries that count what they wrote, as numpy does, do not say why it was too little; the disk does.
        cause = problem if problem.errno else _reason_to_stop(temporary) or problem
        raise error(_sentence(path, cause)) from problem
    finally:
        # After a successful replace there is nothing left to remove.
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def require_writable(path: str | os.PathLike[str], error: type[DiffTetError] = DiffTetError) -> None:
    """Checks that :func:`atomic_write` can begin, before the time to make the content is spent; leaves no trace.

    Args:
        path: The file to write.
        error: The exception to raise.

    Raises:
        DiffTetError: (of type ``error``) There is no such folder, it is not writable, or ``path`` is no ordinary file.
    """
    target = Path(os.path.realpath(path))
    try:
        _replaceable_mode(target)
        _probe(target)
    except OSError as problem:
        raise error(_sentence(path, problem)) from problem


def require_room(path: str | os.PathLike[str], size: int, error: type[DiffTetError] = DiffTetError) -> None:
    """Checks that a disk has room for a file before the time to make its content is spent.

    Args:
        path: The file to write. Its folder must exist.
        size: Bytes.
        error: The exception to raise.

    Raises:
        DiffTetError: (of type ``error``) There is less, or the folder cannot be looked at.
    """
    try:
        if size > shutil.disk_usage(Path(os.path.realpath(path)).parent).free:
            raise OSError(errno.ENOSPC, f"there is no room for its {size / 2**30:.3g} GiB")
    except OSError as problem:
        raise error(_sentence(path, problem)) from problem


def require_writable_folder(path: str | os.PathLike[str], error: type[DiffTetError] = DiffTetError) -> None:
    """Checks that files can be created in a folder, or that it can be created where there is none; leaves no trace.

    Args:
        path: The folder.
        error: The exception to raise.

    Raises:
        DiffTetError: (of type ``error``) It, or the nearest folder above that exists, is no folder or not writable.
    """
    folder = Path(os.path.realpath(path))
    try:
        while not folder.exists() and folder != folder.parent:
            folder = folder.parent
        _probe(folder / "probe")
    except OSError as problem:
        raise error(_sentence(path, problem)) from problem


@contextmanager
def locked(path: str | os.PathLike[str], error: type[DiffTetError], busy: str) -> Iterator[None]:
    """Context manager that one process at a time is in, of all that name the same file.

    The operating system gives the lock up when its process ends, however it ends; the file beside ``path`` that it is
    held on may stay then, and is taken over.

    Args:
        path: The file; it need not exist, its folder must.
        error: The exception to raise.
        busy: What it says when another process, or another thread of this one, is in.

    Raises:
        DiffTetError: (of type ``error``) Another one is in, or no file can be created there.
    """
    import filelock  # Late: few commands lock anything.

    file = Path(os.path.realpath(path))
    file = file.with_name(f"{file.name}.lock")
    lock = filelock.FileLock(file)
    try:
        os.stat(file.parent)  # The library would create it.
        lock.acquire(timeout=0)
    except filelock.Timeout:
        raise error(busy) from None
    except (OSError, NotImplementedError) as problem:
        if isinstance(problem, OSError) and problem.errno not in _NO_LOCKS_HERE:
            raise error(_sentence(path, problem)) from problem
        warnings.warn(
            UnlockedWarning(f"The disk of {path} has no locks; make sure that nothing else writes there."), stacklevel=3
        )
    try:
        yield
    finally:
        # Before it is given up: whoever has opened it meanwhile sees that it is gone.
        with contextlib.suppress(OSError):
            file.unlink()
        lock.release()


class UnlockedWarning(UserWarning):
    """A disk cannot keep two processes from writing the same files."""


def remove_leftovers(folder: Path, stems: str) -> None:
    """Removes what :func:`atomic_write` could not, because its process was killed.

    Args:
        folder: Where to look; it need not exist.
        stems: Regular expression of the names, without suffix, of the files that were to be written.
    """
    pattern = re.compile(rf"\.(?:{stems})-[0-9a-f]{{8}}(?:\.\w+)?")
    with contextlib.suppress(OSError):
        for path in sorted(folder.iterdir()):
            if pattern.fullmatch(path.name) and _is_abandoned(path):
                path.unlink()


def stem_of(path: Path) -> str:
    """The regular expression for :func:`remove_leftovers` of one file."""
    return re.escape(path.stem[:_STEM_LENGTH])


def _temporary_name(target: Path) -> Path:
    return target.with_name(f".{target.stem[:_STEM_LENGTH]}-{secrets.token_hex(4)}{target.suffix}")


@contextmanager
def _created(temporary: Path) -> Iterator[None]:
    """Creates a file, and holds a lock on it as a sign of life; with the process the lock ends, too."""
    descriptor = os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666)
    try:
        if sys.platform != "win32":
            with contextlib.suppress(OSError):
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


def _is_abandoned(temporary: Path) -> bool:
    """Whether nobody is writing a temporary file any more."""
    if sys.platform == "win32":
        return True  # What is open there cannot be removed.
    try:
        descriptor = os.open(temporary, os.O_RDWR | os.O_NONBLOCK | os.O_NOFOLLOW)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return stat.S_ISREG(os.fstat(descriptor).st_mode)
    except OSError:
        return False
    finally:
        os.close(descriptor)


def _probe(target: Path) -> None:
    """Creates and removes a file beside ``target``."""
    temporary = _temporary_name(target)
    with _created(temporary):
        pass
    temporary.unlink(missing_ok=True)


def _reason_to_stop(temporary: Path) -> OSError | None:
    """What keeps a file from growing, None if nothing does."""
    try:
        with temporary.open("ab", buffering=0) as file:
            written = file.write(bytes(_PROBE_BYTES))
            if written < _PROBE_BYTES:
                file.write(bytes(_PROBE_BYTES - written))
    except OSError as reason:
        return reason
    return None


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
