"""Files of words and numbers, in text or binary, as .vtk and .msh are."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np

from difftetvr.errors import MeshError
from difftetvr.mesh.io.content import damaged


class Source:
    """A file that is read from start to end, lines and arrays in turn.

    Nothing is allocated before its size was compared with what is left of the file, whatever the file says.

    Attributes:
        path: The file, for sentences.
        text: Whether numbers are written in text.
        order: Byte order of binary numbers, "<" or ">".
    """

    def __init__(self, path: Path, file: BinaryIO) -> None:
        """Begin at the start of a file.

        Args:
            path: Its name.
            file: A real file, open in binary mode.
        """
        self.path = path
        self.text = True
        self.order: Literal["<", ">"] = "<"
        self._file = file
        self.size = os.fstat(file.fileno()).st_size

    def damaged(self, problem: str) -> MeshError:
        """The error that says what is wrong with this file."""
        return damaged(self.path, problem)

    def line(self) -> str | None:
        """The next line without white space around it; None at the end of the file."""
        line = self._file.readline()
        return line.decode("utf-8", "replace").strip() if line else None

    def next_line(self) -> str | None:
        """The next line that is not empty; None at the end of the file."""
        line = self.line()
        while line == "":
            line = self.line()
        return line

    def words(self, what: str, least: int = 1) -> list[str]:
        """The words of the next line that is not empty.

        Args:
            what: What they are, for the sentence.
            least: How many there must be.

        Raises:
            MeshError: The file ends, or there are fewer.
        """
        line = self.next_line()
        words = line.split() if line else []
        if len(words) < least:
            raise self.damaged(f"it ends, or the line is too short, where {what} should be")
        return words

    def count(self, word: str, what: str) -> int:
        """A number of things, each of which takes at least one byte of the file.

        Args:
            word: The number as written.
            what: What is counted, for the sentence.

        Raises:
            MeshError: It is no number, negative, or more than the file can hold.
        """
        if not word.isascii() or not word.isdigit() or len(word) > 18:
            raise self.damaged(f"{word[:40]!r} is no number of {what}")
        if int(word) > self.size:
            raise self.damaged(f"it announces {int(word)} {what} but has only {self.size} bytes")
        return int(word)

    def numbers(self, count: int, dtype: str, what: str) -> np.ndarray:
        """The next numbers, as text or binary as the file has them.

        Args:
            count: How many.
            dtype: NumPy's name of their type in a binary file, without byte order; text is read as float64 or int64.
            what: What they are, for the sentence.

        Returns:
            (count,) numbers in native byte order.

        Raises:
            MeshError: The file holds fewer.
        """
        kind = np.dtype(dtype).newbyteorder(self.order)
        if self.text:
            kind = np.dtype(np.float64 if kind.kind == "f" else np.int64)
        self._require(2 * count - 1 if self.text else count * kind.itemsize, what)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", DeprecationWarning)
                values = np.fromfile(self._file, kind, count, " " if self.text else "")
        except (DeprecationWarning, ValueError) as error:
            # Older versions of NumPy only warn of text that is no number.
            raise self.damaged(f"there is something else where {what} must be") from error
        if values.size != count:
            raise self.damaged(f"{what} are incomplete: {values.size} of {count}")
        return values.astype(kind.newbyteorder("="), copy=False)

    def records(self, count: int, dtype: np.dtype, what: str) -> np.ndarray:
        """The next records of a binary file, (count,) of a structured type; see `numbers`."""
        self._require(count * dtype.itemsize, what)
        values = np.fromfile(self._file, dtype, count)
        if values.size != count:
            raise self.damaged(f"{what} are incomplete: {values.size} of {count}")
        return values

    def take(self, count: int, what: str) -> bytes:
        """The next bytes; see `numbers`."""
        self._require(count, what)
        return self._file.read(count)

    def until(self, mark: bytes, what: str) -> bytes:
        """What comes before the next line that begins with a mark; reading goes on after that line.

        Raises:
            MeshError: There is no such line.
        """
        lines: list[bytes] = []
        for line in self._file:
            if line.startswith(mark):
                return b"".join(lines)
            lines.append(line)
        raise self.damaged(f"{what} do not end")

    def position(self) -> int:
        """Where the next read begins, for `seek`."""
        return self._file.tell()

    def seek(self, position: int) -> None:
        """Go on reading elsewhere."""
        self._file.seek(position)

    def _require(self, size: int, what: str) -> None:
        left = self.size - self._file.tell()
        if size > left:
            raise self.damaged(f"{what} need at least {size} bytes but only {left} are left")
