"""Interrupts that wait for the end of an iteration."""

from __future__ import annotations

import signal
import threading
from types import FrameType
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class InterruptFlag:
    """Turns the first SIGINT or SIGTERM inside a ``with`` block into a flag; the second one has its usual effect.

    A step that was cut short would leave moments and parameters of different iterations; the loop looks at the flag
    between iterations instead. Outside the main thread, where Python delivers no signals, the flag is never raised.

    Attributes:
        raised: Whether a signal has come.
    """

    def __init__(self, active: bool = True) -> None:
        self.raised = False
        self._active = active and threading.current_thread() is threading.main_thread()
        self._previous: dict[signal.Signals, Any] = {}

    def __enter__(self) -> InterruptFlag:
        if self._active:
            self._previous = {number: signal.signal(number, self._raise) for number in _SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        self._restore()

    def _raise(self, number: int, frame: FrameType | None) -> None:
        self.raised = True
        self._restore()

    def _restore(self) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)
        self._previous = {}
