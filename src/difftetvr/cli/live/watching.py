"""Options of who is told how a run goes: TensorBoard, and whoever looks at it in a browser."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from tyro.conf import OmitArgPrefixes

from difftetvr.cli.live.listening import VIEWER_GROUP, ServerOptions
from difftetvr.fitting.records.folder import RunFolder

if TYPE_CHECKING:
    from rich.console import Console

    from difftetvr.capture import Capture
    from difftetvr.fitting.records.result import Progress
    from difftetvr.view.live.scene import Scene
    from difftetvr.view.live.watching import RunWatcher

WATCH_GROUP = ("tensorboard", "view", *VIEWER_GROUP)
"""Names of the options below."""


@dataclass(frozen=True)
class WatchOptions:
    """Who is told how a run goes."""

    tensorboard: bool = False
    """Write curves, held-out pictures and the quality of cells into OUT/tensorboard, for `tensorboard --logdir`."""
    view: bool = False
    """Show the run in a browser while it goes on, where it can be paused and given another number of cells."""
    server: OmitArgPrefixes[ServerOptions] = field(default_factory=ServerOptions)

    def require(self) -> None:
        """Checks that they can be told, before anything is read or replaced.

        Raises:
            DiffTetError: A package is not installed, or nobody could listen there.
        """
        if self.tensorboard:
            from difftetvr.fitting.records.tensorboard import require_tensorboard

            require_tensorboard()
        self.server.require_valid()
        if self.view:
            from difftetvr.view.live.server import require_free, require_viewer

            require_viewer()
            require_free(self.server.host, self.server.port)

    @contextlib.contextmanager
    def telling(
        self, folder: RunFolder, console: Console, capture: Capture | None = None
    ) -> Iterator[Callable[[Progress], None]]:
        """Context of a run that can be gone on with: gives what to call after every iteration.

        Args:
            folder: The run's.
            console: Where its progress is shown.
            capture: Images that it learns from, to be looked at, too.

        Raises:
            DiffTetError: A package is not installed, or nothing can be written into a folder.
        """
        from difftetvr.fitting.records.progress import ProgressDisplay
        from difftetvr.fitting.records.tensorboard import TensorBoardLogger

        try:
            with contextlib.ExitStack() as stack:
                listeners: list[Callable[[Progress], None]] = [stack.enter_context(ProgressDisplay(console))]
                if self.tensorboard:
                    listeners.append(stack.enter_context(TensorBoardLogger(folder.logs)))
                if self.view:  # last, for it may hold the run up
                    listeners.append(stack.enter_context(self._watcher(folder, console, capture)))

                def tell(progress: Progress) -> None:
                    for listener in listeners:
                        listener(progress)

                yield tell
        except KeyboardInterrupt:
            command = shlex.join(["difftetvr", "fit", "-o", str(folder.path), "--resume"])
            console.print(f"Interrupted; continue with: {command}")
            raise

    def _watcher(self, folder: RunFolder, console: Console, capture: Capture | None) -> RunWatcher:
        from difftetvr.view.live.server import Listening
        from difftetvr.view.live.watching import RunWatcher

        def scene_of(progress: Progress) -> Scene:
            return _scene_of(progress, folder, console, capture)

        def say(sentence: str) -> None:
            console.print(sentence, highlight=False, soft_wrap=True)

        listening = Listening(folder.path / "saved", self.server.host, self.server.port)
        return RunWatcher(listening, scene_of, say)


def _scene_of(progress: Progress, folder: RunFolder, console: Console, capture: Capture | None) -> Scene:
    """What there is to see of a run, looked at as its model will be."""
    from difftetvr.capture import CameraSet
    from difftetvr.cli.drawing.cameras import CameraOptions, Place
    from difftetvr.cli.live.scenes import scene_around
    from difftetvr.view.live.contents import MeshContent
    from difftetvr.view.live.scene import Views
    from difftetvr.view.live.settings import Settings

    place = Place(folder.model, CameraOptions(), console)
    if capture is not None and place.is_of_photographs:
        place.take(CameraSet(capture.cameras, capture.test, capture.name))
    content, views = MeshContent(progress.mesh, progress.field), None if capture is None else Views.of(capture)
    return scene_around(str(folder.path), content, place, views, Settings(background=place.background(None)))
