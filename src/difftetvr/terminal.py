"""What the command line says: text that is shown as it is, and one sentence for every failure that users can mend."""

from __future__ import annotations

import contextlib
import errno
import io
import re
import sys
import threading
from collections.abc import Iterator

from rich.console import Console
from rich.text import Text

from difftetvr.errors import DiffTetError

_LONG_SECONDS = 3.0
_NO_MEMORY = "There is not enough memory; use fewer cells, or fewer or smaller views."
# Torch's and Dr.Jit's allocators raise RuntimeErrors like any others; only their words tell them apart.
_ALLOCATION = re.compile(
    r"DefaultCPUAllocator|(?:can't|cannot|could not|unable to|failed to) allocate|out[ _]of[ _]memory|not enough memory"
    r"|bad[_ ]alloc",
    re.IGNORECASE,
)


def console() -> Console:
    """Standard output for text with names of files in it: nothing in the text is markup.

    Characters that the output's encoding lacks are written as escapes.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.reconfigure(errors="backslashreplace")
    return Console(markup=False, emoji=False, highlight=False, soft_wrap=True)


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


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error of Python, NumPy, PyTorch or Dr.Jit means that memory is short."""
    torch = sys.modules.get("torch")  # only what has been imported can have raised
    if isinstance(error, MemoryError) or (torch is not None and isinstance(error, torch.OutOfMemoryError)):
        return True
    if isinstance(error, OSError):
        return error.errno == errno.ENOMEM
    return isinstance(error, RuntimeError) and _ALLOCATION.search(str(error)) is not None


def _one_line(text: str) -> str:
    """The text with line breaks and other control characters, such as names of files may hold, as escapes."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
