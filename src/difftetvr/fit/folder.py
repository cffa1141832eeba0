"""The output folder of a reconstruction: which run it holds, and whether another may go there."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from difftetvr.files import atomic_write
from difftetvr.fit.errors import FitError


@dataclass(frozen=True)
class RunFolder:
    """Names of what a reconstruction leaves in its folder.

    Attributes:
        path: The folder.
    """

    path: Path

    @property
    def config(self) -> Path:
        """Options of the run, JSON."""
        return self.path / "config.json"

    @property
    def checkpoint(self) -> Path:
        """State to resume from, safetensors."""
        return self.path / "checkpoint.safetensors"

    @property
    def model(self) -> Path:
        """The resulting mesh and field."""
        return self.path / "model.vtu"

    @property
    def metrics(self) -> Path:
        """Numbers of the result, JSON; written last."""
        return self.path / "metrics.json"

    @property
    def curves(self) -> Path:
        """Plot of loss and PSNR."""
        return self.path / "curves.png"

    @property
    def comparison(self) -> Path:
        """A few held-out views: truth, reconstruction and difference side by side."""
        return self.path / "comparison.png"

    @property
    def views(self) -> Path:
        """Folder of single pictures of held-out views."""
        return self.path / "views"

    def holds_run(self) -> bool:
        """Whether a run has written into the folder."""
        return any(p.exists() for p in (self.config, self.checkpoint, self.model, self.metrics))

    def require_free(self, *, resume: bool, overwrite: bool) -> None:
        """Checks that a run may go into the folder; changes nothing.

        Args:
            resume: The run in the folder will be continued.
            overwrite: The run in the folder will be replaced.

        Raises:
            FitError: The folder holds a run and neither is set, both are, or it is a file.
        """
        if resume and overwrite:
            raise FitError("--resume and --overwrite contradict each other; give one of them.")
        if self.holds_run() and not resume and not overwrite:
            raise FitError(
                f"{self.path} already holds a run; continue it with --resume, replace it with --overwrite, or choose "
                "another folder."
            )
        if self.path.exists() and not self.path.is_dir():
            raise FitError(f"{self.path} is a file, so no folder can have this name; choose another.")

    def create(self, *, overwrite: bool) -> None:
        """Creates the folder where there is none.

        Args:
            overwrite: Remove the files of a run in it; others are left alone.

        Raises:
            FitError: The folder cannot be created or emptied.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            if overwrite:
                self._clear()
        except OSError as error:
            raise FitError(f"The folder {self.path} cannot be used ({error.strerror}); choose another.") from error

    def read_config(self) -> dict[str, Any] | None:
        """Options of the run in the folder, None if it holds none.

        Raises:
            FitError: The file is damaged.
        """
        if not self.config.is_file():
            return None
        try:
            options = json.loads(self.config.read_text())
        except (OSError, ValueError) as error:
            raise FitError(f"{self.config} cannot be read ({error}); start anew with --overwrite.") from error
        if not isinstance(options, dict):
            raise FitError(f"{self.config} holds no options; start anew with --overwrite.")
        return options

    def _clear(self) -> None:
        for path in (self.config, self.checkpoint, self.model, self.metrics, self.curves, self.comparison):
            path.unlink(missing_ok=True)
        for pattern in ("*_truth.png", "*_reconstruction.png"):
            for picture in self.views.glob(pattern):
                picture.unlink()


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Writes JSON, whole or not at all.

    Raises:
        FitError: The file cannot be written.
    """
    with atomic_write(path, FitError) as temporary:
        temporary.write_text(json.dumps(values, indent=2) + "\n")
