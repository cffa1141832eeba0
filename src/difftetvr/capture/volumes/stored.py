"""Where files keep samples, and reading them from there: no more than files can hold, and memory can."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Literal

from difftetvr.errors import CaptureError
from difftetvr.trust import free_memory, require_modest, require_regular

Encoding = Literal["raw", "gzip", "zlib", "bzip2", "xz"]

# Bytes that one stored byte can become at most: by DEFLATE's definition, else what runs of zeros do, rounded up.
_MOST_OF_ONE = {"raw": 1, "gzip": 1040, "zlib": 1040, "bzip2": 2**21, "xz": 2**14}
_AT_ONCE = 2**20

AT_END = -1
"""As ``skip``: the samples are the last bytes of the file."""


@dataclass(frozen=True)
class Stored:
    """Samples in a file.

    Attributes:
        path: The file.
        encoding: How they are compressed.
        start: Bytes of the file before them.
        skip: Decoded bytes before them, or `AT_END`.
    """

    path: Path
    encoding: Encoding = "raw"
    start: int = 0
    skip: int = 0

    def read(self, count: int) -> bytes:
        """So many decoded bytes; fewer where there are no more, one more where there are.

        Raises:
            CaptureError: The file cannot be read or decoded, cannot hold as many bytes, or they need too much memory.
        """
        size = file_size(self.path)
        start = max(size - count, 0) if self.skip == AT_END else min(self.start, size)
        skip = max(self.skip, 0)
        room = (size - start) * _MOST_OF_ONE[self.encoding]
        if self.encoding == "raw":
            count, start, skip = min(count, max(room - skip, 0)), min(start + skip, size), 0
        elif skip + count > room:
            raise CaptureError(
                f"'{self.path}' is damaged or its header wrong: {size - start} bytes of {self.encoding} data cannot "
                f"hold the {count} bytes that are announced; get the file anew."
            )
        require_modest(self.path, skip + count, "samples", CaptureError)
        with _reading(self.path, self.encoding) as file:
            file.seek(start)
            return _decoded(file, self.encoding, skip, count + 1)

    def read_text(self, numbers: int) -> bytes:
        """All that is there, as text that holds so many numbers.

        Raises:
            CaptureError: The file cannot be read, or is too short.
        """
        size = max(file_size(self.path) - self.start - max(self.skip, 0), 0)
        # A digit and a space for each but the last.
        if 2 * numbers - 1 > size:
            raise CaptureError(
                f"'{self.path}' holds {size} bytes of text, too few for the {numbers} numbers that are announced; it "
                "is damaged, so get the file anew."
            )
        with _reading(self.path, "raw") as file:
            file.seek(self.start + max(self.skip, 0))
            return file.read()


def read_parts(parts: Sequence[Stored], count: int, owner: Path) -> bytes:
    """Decoded bytes of a volume that lies in one file or, in equal parts, in several.

    Args:
        parts: The files, in the order of the samples.
        count: Bytes of all parts together; a multiple of their number.
        owner: The file that names them.

    Raises:
        CaptureError: A file cannot be read, or one of several holds more or less than its part.
    """
    if len(parts) == 1:
        return parts[0].read(count)
    share = count // len(parts)
    for part in parts:
        stored = file_size(part.path)
        if stored * _MOST_OF_ONE[part.encoding] < share:
            raise _wrong_size(part.path, f"{stored} bytes", share, owner)
    require_memory(owner, count)
    data = bytearray()
    for part in parts:
        piece = part.read(share)
        if len(piece) != share:
            amount = f"only {len(piece)} bytes" if len(piece) < share else "more bytes"
            raise _wrong_size(part.path, amount, share, owner)
        data += piece
    return bytes(data)


def behind_lines(path: Path, start: int, lines: int) -> int:
    """Where so many lines from a place of a file end.

    Raises:
        CaptureError: The file cannot be read.
    """
    require_regular(path, CaptureError)
    with _reading(path, "raw") as file:
        file.seek(start)
        while lines > 0 and (piece := file.readline(_AT_ONCE)):
            lines -= piece.endswith(b"\n")
        return file.tell()


def first_bytes(path: Path, count: int, encoding: Encoding = "raw") -> bytes:
    """The decoded beginning of a file, for its header.

    Raises:
        CaptureError: The file cannot be read or decoded.
    """
    require_regular(path, CaptureError)
    with _reading(path, encoding) as file:
        return _decoded(file, encoding, 0, count)


def require_memory(path: Path, count: int) -> None:
    """Holds bytes that lie in several files against the memory that is free.

    Raises:
        CaptureError: It is less.
    """
    if count > free_memory():
        size = f"{count / 2**30:.3g} GiB"
        raise CaptureError(f"The samples of '{path}' need {size}, more memory than is free; crop the volume.")


def file_size(path: Path) -> int:
    """Bytes of an ordinary file.

    Raises:
        CaptureError: There is none, or it is a pipe or a device.
    """
    require_regular(path, CaptureError)
    try:
        return path.stat().st_size
    except OSError as error:
        raise CaptureError(f"Cannot read '{path}': {error.strerror or error}.") from None


@contextmanager
def _reading(path: Path, encoding: Encoding) -> Iterator[IO[bytes]]:
    """An open file; what goes wrong while it is read becomes one sentence."""
    damaged = CaptureError(f"The {encoding} data of '{path}' is damaged or cut short; get the file anew.")
    try:
        with path.open("rb") as file:
            yield file
    except (EOFError, zlib.error, lzma.LZMAError, gzip.BadGzipFile):
        raise damaged from None
    except OSError as error:
        # bz2 tells damage by an error of the system that has no number.
        if error.errno is None:
            raise damaged from None
        raise CaptureError(f"Cannot read '{path}': {error.strerror or error}.") from None


def _decoded(file: IO[bytes], encoding: Encoding, skip: int, count: int) -> bytes:
    """At most so many decoded bytes behind those to skip."""
    if encoding == "raw":
        file.seek(skip, io.SEEK_CUR)
        return file.read(count)
    if encoding == "zlib":
        return _inflated(file, skip + count)[skip:]
    opener: Any = {"gzip": gzip.open, "bzip2": bz2.open, "xz": lzma.open}[encoding]
    with opener(file, "rb") as unpacked:
        while skip > 0 and (passed := len(unpacked.read(min(skip, _AT_ONCE)))):
            skip -= passed
        return unpacked.read(count)


def _inflated(file: IO[bytes], count: int) -> bytes:
    """At most so many bytes of one zlib or gzip stream."""
    stream, data = zlib.decompressobj(zlib.MAX_WBITS + 32), bytearray()
    while len(data) < count and not stream.eof:
        piece = stream.unconsumed_tail or file.read(_AT_ONCE)
        if not piece:
            raise EOFError
        data += stream.decompress(piece, count - len(data))
    return bytes(data)


def _wrong_size(path: Path, amount: str, share: int, owner: Path) -> CaptureError:
    return CaptureError(
        f"'{path}' holds {amount} where its part of the volume of '{owner}' needs {share}; check the header, or get "
        "the file anew if it is damaged."
    )
