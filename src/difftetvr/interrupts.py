"""Signals that ask a process to stop: what they cut short, what they wait for, and that they leave nothing behind."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from types import FrameType
from typing import Any

INTERRUPTED = 130
"""Exit code of a process that was asked to stop."""

_HANGUP: list[signal.Signals] = [signal.SIGHUP] if hasattr(signal, "SIGHUP") else []
_SIGNALS = (signal.SIGINT, signal.SIGTERM, *_HANGUP)
_SHOW_CURSOR = b"\x1b[?25h"


class _Handlers:
    """Base of contexts with handlers of their own for signals, in the main thread, where alone Python delivers them."""

    def __init__(self) -> None:
        self._previous: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Any:
        if threading.current_thread() is threading.main_thread():
            self._previous = {number: signal.signal(number, self._handle) for number in _SIGNALS if self._takes(number)}
        return self

    def __exit__(self, *_: object) -> None:
        self._restore()

    def _takes(self, number: signal.Signals) -> bool:
        raise NotImplementedError

    def _handle(self, number: int, frame: FrameType | None) -> None:
        raise NotImplementedError

    def _restore(self) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)
        self._previous = {}


class InterruptFlag(_Handlers):
    """Turns the first SIGINT, SIGTERM or SIGHUP inside a ``with`` block into a flag; the second has its usual effect.

    A step that was cut short would leave moments and parameters of different iterations; the loop looks at the flag
    between iterations instead. Outside the main thread, where Python delivers no signals, the flag is never raised.

    Args:
        active: Whether to do so at all.
        patient: Whether the second has no effect either, as where a launcher of several processes hands on to each
            what has reached all of them already.

    Attributes:
        raised: Whether a signal has come.
    """

    def __init__(self, active: bool = True, patient: bool = False) -> None:
        super().__init__()
        self.raised = False
        self._active = active
        self._patient = patient

    def _takes(self, number: signal.Signals) -> bool:
        # nohup has hang-ups ignored so that the run goes on.
        return self._active and not (number in _HANGUP and signal.getsignal(number) is signal.SIG_IGN)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.raised = True
        if not self._patient:
            self._restore()


class OrderlyExit(_Handlers):
    """Has SIGINT, SIGTERM and SIGHUP inside a ``with`` block raise KeyboardInterrupt, so that all is left in order.

    Amid an import the process leaves at once instead, with exit code 130: there Python and compiled modules lose that
    exception, or make others of it, and nothing is half done. Signals that are handled or ignored already stay so.

    Args:
        patient: Whether signals after the first have no effect, see `InterruptFlag`.

    Attributes:
        raised: Whether a signal has come.
    """

    def __init__(self, patient: bool = False) -> None:
        super().__init__()
        self.raised = False
        self._patient = patient

    def _takes(self, number: signal.Signals) -> bool:
        return signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.raised and self._patient:
            return
        self.raised = True
        if _is_import(frame):
            _leave()
        raise KeyboardInterrupt


def _is_import(frame: FrameType | None) -> bool:
    """Whether a frame is, or was called by, one of an import."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib._bootstrap"):
            return True
        frame = frame.f_back
    return False


def _leave() -> None:
    with contextlib.suppress(Exception):  # the signal may have come while something was written
        sys.stdout.flush()
        if os.name == "posix" and sys.stdout.isatty():
            os.write(sys.stdout.fileno(), _SHOW_CURSOR)
    os._exit(INTERRUPTED)
