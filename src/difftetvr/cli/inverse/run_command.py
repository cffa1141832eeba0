"""What the variants of ``difftetvr fit`` do alike around a reconstruction: its folder, its progress, its end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from difftetvr.cli.live.watching import WatchOptions
from difftetvr.fitting.records.folder import RunFolder
from difftetvr.terminal import waiting

if TYPE_CHECKING:
    from rich.console import Console

    from difftetvr.capture import Capture


@dataclass(frozen=True)
class Begun:
    """A run that is ready to iterate.

    Attributes:
        iteration: Iterations done, as they are then.
        options: What its config.json is to hold.
        optimise: Iterates to the end; takes the checkpoint's file and a display of progress.
        report: Writes the result's files into a folder; returns lines that say what came of it.
        capture: The images that it is about, to be looked at; None where it is about others.
    """

    iteration: Callable[[], int]
    options: dict[str, Any]
    optimise: Callable[[Path, Any], Any]
    report: Callable[[RunFolder, Any], list[str]]
    capture: Capture | None = None


class RunCommand:
    """Base of dataclasses of commands that reconstruct something in a folder.

    Attributes:
        output: The folder.
        resume: Whether to go on with the run there.
        overwrite: Whether to replace it.
        watch: Who is told how it goes.
    """

    output: Path
    resume: bool
    overwrite: bool
    watch: WatchOptions

    def require_same_run(self, folder: RunFolder) -> None:
        """Checks that the run to go on with is the one that is asked for.

        Raises:
            FitError: It is another.
        """
        raise NotImplementedError

    def begin(self, console: Console, checkpoint: Path | None) -> Begun:
        """Everything that can fail before the first iteration.

        Args:
            console: Where to say what was chosen.
            checkpoint: Where to go on from; None: anew.
        """
        raise NotImplementedError

    def run(self, console: Console) -> None:
        """Reconstructs, and fills the output folder."""
        folder = RunFolder(self.output)
        with folder.claimed():
            self.watch.require()
            if self.resume:
                self.require_same_run(folder)
            folder.require_free(resume=self.resume, overwrite=self.overwrite)
            begun = self.begin(console, folder.checkpoint if self.resume else None)
            with folder.occupied(begun.options, overwrite=self.overwrite, begun=lambda: begun.iteration() > 0):
                result = self._optimise(begun, folder, console)
            with waiting(console, f"Drawing pictures into {self.output}"):
                lines = begun.report(folder, result)
        console.print("\n".join(lines), highlight=False)

    def _optimise(self, begun: Begun, folder: RunFolder, console: Console) -> Any:
        with self.watch.telling(folder, console, begun.capture) as tell:
            return begun.optimise(folder.checkpoint, tell)
