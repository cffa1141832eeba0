"""A run that is looked at while it goes on, that can be paused and given another number of cells."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any

import torch

from difftetvr.errors import DiffTetError
from difftetvr.fitting.records.result import Progress
from difftetvr.mesh import Field
from difftetvr.rendering import ScalarField
from difftetvr.view.live.contents import MeshContent
from difftetvr.view.live.panels.run import RunPanel
from difftetvr.view.live.scene import Scene
from difftetvr.view.live.server import Listening, LiveServer

_REFRESH_SECONDS = 1.0
"""Between looks at the mesh as it has become."""

_SHARE = 0.25  # of the time that iterations take, in which pictures may be drawn
_MOST_SAVED, _MOST_OWED = 0.5, 2.0  # seconds of that which are carried on
_PAUSE_SECONDS = 0.1  # between looks whether a pause has ended


class RunWatcher:
    """Shows a run in browsers; a context manager to be passed as ``on_progress``.

    The pages are there after the first iteration. They are drawn between iterations, on the thread of the run, in a
    share of its time, and at leisure while it pauses.

    Args:
        listening: Where to listen.
        scene_of: What there is to see at first.
        say: Told where it is to be seen.
    """

    def __init__(self, listening: Listening, scene_of: Callable[[Progress], Scene], say: Callable[[str], None]) -> None:
        self._listening, self._scene_of, self._say = listening, scene_of, say
        self._open: tuple[LiveServer, RunPanel] | None = None
        self._refreshed = self._left = self._left_over = 0.0
        self._has_failed = False

    def __enter__(self) -> RunWatcher:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()

    def _close(self) -> None:
        if self._open is not None:
            self._open[0].close()
            self._open = None

    @property
    def shown(self) -> tuple[LiveServer, RunPanel] | None:
        """What serves the pages, and their panel of the run; None before the first iteration."""
        return self._open

    def __call__(self, progress: Progress) -> None:
        """Draws for those who look, does what they ask, and waits as long as they want the run to pause."""
        if self._has_failed:
            return
        try:
            self._watch(*self._opened(progress), progress)
        except Exception as error:  # whatever is wrong with a picture is no reason to lose the run that it is of
            self._has_failed = True
            self._say(f"The viewer has ended, the run goes on without it: {' '.join(str(error).split())}")
            self._close()

    def _watch(self, server: LiveServer, panel: RunPanel, progress: Progress) -> None:
        panel.tell(progress)
        self._steer(panel, progress)
        if server.is_watched:
            self._refresh(server, progress)
            self._draw(server)
        if panel.is_paused:
            server.studio.replace(_seen(server.studio.scene, progress))
        while panel.is_paused and not progress.is_interrupted():
            server.studio.work(_PAUSE_SECONDS)
            self._steer(panel, progress)
        self._left = time.monotonic()

    def _opened(self, progress: Progress) -> tuple[LiveServer, RunPanel]:
        if self._open is None:
            server = LiveServer(_seen(self._scene_of(progress), progress), self._listening)
            self._open = (server, RunPanel(server.desk, progress))
            self._say(server.announcement)
            self._left = time.monotonic()
        return self._open

    def _steer(self, panel: RunPanel, progress: Progress) -> None:
        budget = panel.take_budget()
        if budget is not None:
            try:
                progress.steer(budget)
            except DiffTetError as error:
                panel.refuse(str(error))

    def _refresh(self, server: LiveServer, progress: Progress) -> None:
        now = time.monotonic()
        if now - self._refreshed >= _REFRESH_SECONDS:
            self._refreshed = now
            server.studio.replace(_seen(server.studio.scene, progress))

    def _draw(self, server: LiveServer) -> None:
        """Draws in the share of the last iteration's time that is drawing's, and what was left over of that before."""
        start = time.monotonic()
        self._left_over = min(self._left_over + _SHARE * (start - self._left), _MOST_SAVED)
        while self._left_over > 0.0 and server.studio.work(0.0):
            end = time.monotonic()
            self._left_over, start = max(self._left_over - (end - start), -_MOST_OWED), end


def _seen(scene: Scene, progress: Progress) -> Scene:
    """A scene with the mesh of now, in copies that the next iterations do not change."""
    mesh, field = progress.mesh, progress.field
    mesh = mesh.with_vertices(mesh.vertices.detach().clone())
    return dataclasses.replace(scene, content=MeshContent(mesh, _copied(field)))


def _copied(field: Field | ScalarField) -> Field | ScalarField:
    values = ((item.name, getattr(field, item.name)) for item in dataclasses.fields(field))
    copies: dict[str, Any] = {name: v.detach().clone() for name, v in values if isinstance(v, torch.Tensor)}
    return dataclasses.replace(field, **copies)
