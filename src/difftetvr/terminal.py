"""What the command line says: text that is shown as it is, and one sentence for every failure that users can mend."""

from __future__ import annotations

import contextlib
import io
import os
import re
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Literal, TextIO

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.text import Text

from difftetvr.errors import DiffTetError, counted
from difftetvr.memory import is_out_of_memory

_LONG_SECONDS = 3.0
_NARROWEST, _WIDEST, _LOWEST = 20, 500, 5
# C0 and C1 codes but line breaks, what turns the direction of writing, other line breaks, halves of characters.
_CONTROLS = re.compile(r"[\x00-\x09\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
_ENDLESS = re.compile(r"(\S{100})\S{800,}(\S{100})")
_NO_MEMORY = "There is not enough memory; use fewer cells, or fewer or smaller views."


class _Listener:
    """A standard stream that falls silent when nobody reads it any longer; the command goes on and writes its files."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Writes text, or not."""
        self._try(lambda: self._stream.write(text))
        return len(text)

    def flush(self) -> None:
        """Hands on what has been written."""
        self._try(self._stream.flush)

    def _try(self, action: Callable[[], object]) -> None:
        try:
            action()
        except BrokenPipeError:
            self._silence()
        except OSError:
            self._silence()
            raise

    def _silence(self) -> None:
        # What is still in the buffer goes to nowhere, too, also when the interpreter ends.
        with contextlib.suppress(OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


class _PlainConsole(Console):
    """A console on which text moves no cursor and sets no title or colour; only its own styles do."""

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(printable(text), **options)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(printable(segment.text), segment.style)


def console() -> Console:
    """Standard output for text with names of files and arrays in it: nothing in the text is markup or a control code.

    Characters that the output's encoding lacks are written as escapes, and so are control characters.
    """
    out = _PlainConsole(file=_stream("stdout"), markup=False, emoji=False, highlight=False, soft_wrap=True)
    # The environment may say anything; no layout fits fewer columns, and padding fills as many as there are.
    width = min(max(out.width, _NARROWEST), _WIDEST)
    height = min(max(out.height, _LOWEST), _WIDEST)
    if (width, height) != (out.width, out.height):
        out.size = (width, height)
    return out


def printable(text: str) -> str:
    """A text with the characters as escapes that a terminal would obey instead of showing them; line breaks stay."""
    return _CONTROLS.sub(lambda found: repr(found[0])[1:-1], text)


def complain(sentence: str) -> None:
    """Prints on standard error what is wrong."""
    _print_error(f"difftetvr: {_one_line(sentence)}\n")


def finish() -> None:
    """Hands on all that has been printed.

    Raises:
        OSError: That failed, as on a full disk.
    """
    stream = _stream("stdout")
    if stream is not None:
        stream.flush()


@contextlib.contextmanager
def plain_warnings() -> Iterator[None]:
    """Context in which warnings are shown as sentences, where they are this package's, and without control codes."""

    def show(message: Warning | str, category: type[Warning], filename: str, number: int, *_: object) -> None:
        if category.__module__.partition(".")[0] == __name__.partition(".")[0]:
            complain(str(message))
        else:
            _print_error(printable(warnings.formatwarning(message, category, filename, number)))

    with warnings.catch_warnings():
        warnings.showwarning = show  # type: ignore[assignment]
        yield


def _print_error(text: str) -> None:
    stream = _stream("stderr")
    if stream is not None:
        with contextlib.suppress(OSError):
            stream.write(text)
            stream.flush()


def _stream(name: Literal["stdout", "stderr"]) -> Any:
    """A standard stream, None where the process has none, which can write all characters and bears to be left."""
    stream = getattr(sys, name)
    if isinstance(stream, io.TextIOWrapper):
        with contextlib.suppress(OSError, ValueError):
            stream.reconfigure(errors="backslashreplace")
    return None if stream is None else _Listener(stream)


@contextlib.contextmanager
def waiting(console: Console, text: str) -> Iterator[None]:
    """Says what is going on while something takes its time.

    On a terminal the text stands beside something that turns; elsewhere it becomes a line if it takes long.

    Args:
        console: Where to show it.
        text: Shown as it is.
    """
    if console.is_terminal:
        spinner = "dots" if console.encoding.startswith("utf") else "line"
        with console.status(Text(text), spinner=spinner):
            yield
        return
    line = threading.Timer(_LONG_SECONDS, lambda: console.print(f"{text} ...", highlight=False))
    line.daemon = True
    line.start()
    try:
        yield
    finally:
        line.cancel()


@contextlib.contextmanager
def counting(console: Console, text: str, noun: str) -> Iterator[Callable[[int, int], None]]:
    """Says how far something has come that takes its time.

    On a terminal a bar grows beside the text; elsewhere a line says it every few seconds.

    Args:
        console: Where to show it.
        text: What is going on, shown as it is.
        noun: What is counted.

    Yields:
        A function of the number that is done, and of all.
    """
    due = time.monotonic() + _LONG_SECONDS

    def say(done: int, total: int) -> None:
        nonlocal due
        if time.monotonic() >= due and done < total:
            due = time.monotonic() + _LONG_SECONDS
            console.print(f"{text}: {done:,} of {counted(total, noun)} ...", highlight=False)

    if not console.is_terminal:
        yield say
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn  # late: most commands show none

    shown = TextColumn("{task.description}", markup=False)
    with Progress(shown, BarColumn(), MofNCompleteColumn(), console=console, transient=True) as bar:
        task = bar.add_task(printable(text), total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def sentence_for(error: Exception) -> str | None:
    """What to tell the user about a failure, in one line; None for what only a programmer can mend.

    Args:
        error: What a command raised.
    """
    if is_out_of_memory(error):
        return _NO_MEMORY
    if isinstance(error, DiffTetError):
        return _one_line(str(error))
    if isinstance(error, OSError):
        return _one_line(f"{error.strerror or error}{f': {error.filename}' if error.filename else ''}.")
    return None


def _one_line(text: str) -> str:
    """The text with line breaks, too, as escapes, and without the middles of endless words, such as wrong paths."""
    return _ENDLESS.sub(r"\1...\2", printable(text).replace("\n", "\\n"))
