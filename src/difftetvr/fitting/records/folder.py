"""The output folder of a reconstruction: which run it holds, and whether another may go there."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from difftetvr.errors import FitError
from difftetvr.files import atomic_write, locked, remove_leftovers, require_writable_folder, stem_of

_PICTURES = ("truth", "reconstruction")


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
    def cut(self) -> Path:
        """A cut through the mesh: what it holds, and where its cells are."""
        return self.path / "cut.png"

    @property
    def cameras(self) -> Path:
        """Cameras as they were found, where they were unknown."""
        return self.path / "cameras.json"

    @property
    def transfer_function(self) -> Path:
        """What scalars look like, JSON, where the model holds some."""
        return self.path / "transfer_function.json"

    @property
    def views(self) -> Path:
        """Folder of single pictures of held-out views."""
        return self.path / "views"

    @property
    def logs(self) -> Path:
        """Folder of what TensorBoard shows."""
        return self.path / "tensorboard"

    @property
    def files(self) -> tuple[Path, ...]:
        """All of these but the folders of pictures and logs.

        In this order they are removed: cut short, that never leaves a state to resume from without the options that it
        belongs to.
        """
        return (
            self.checkpoint,
            self.model,
            self.metrics,
            self.curves,
            self.comparison,
            self.cut,
            self.cameras,
            self.transfer_function,
            self.config,
        )

    def holds_run(self) -> bool:
        """Whether a run has written into the folder."""
        return any(p.exists() for p in (self.config, self.checkpoint, self.model, self.metrics))

    def require_free(self, *, resume: bool, overwrite: bool) -> None:
        """Checks that a run may go into the folder; changes nothing.

        Args:
            resume: The run in the folder will be continued.
            overwrite: The run in the folder will be replaced.

        Raises:
            FitError: The folder holds a run and neither is set, both are, or something stands where a file or a folder
                of the run belongs.
        """
        if resume and overwrite:
            raise FitError("--resume and --overwrite contradict each other; give one of them.")
        if self.holds_run() and not resume and not overwrite:
            raise FitError(
                f"{self.path} already holds a run; continue it with --resume, replace it with --overwrite, or choose "
                "another folder."
            )
        for path in self.files:
            if path.is_dir():
                raise FitError(f"{path} is a folder where the {path.stem} should be a file; rename or remove it.")
        for folder, content in ((self.views, "pictures"), (self.logs, "logs")):
            if folder.exists():
                if not folder.is_dir():
                    raise FitError(f"{folder} is a file where the folder of {content} should be; rename or remove it.")
                require_writable_folder(folder, FitError)

    @contextmanager
    def claimed(self) -> Iterator[None]:
        """Context manager that one run at a time is in: creates the folder where there is none, and sweeps it.

        Swept is what runs that were killed had half written. Folders that this call created and that are empty in the
        end are removed.

        Raises:
            FitError: Another run is in, the folder is a file, or nothing can be created in it.
        """
        if self.path.exists() and not self.path.is_dir():
            raise FitError(f"{self.path} is a file, so no folder can have this name; choose another.")
        require_writable_folder(self.path, FitError)
        absent = [p for p in (self.path, *self.path.parents) if not p.exists()]
        busy = f"Another run is going on in {self.path}; wait for it, stop it, or choose another folder."
        try:
            try:
                self.path.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise self._unusable(error) from error
            with locked(self.checkpoint, FitError, busy):
                remove_leftovers(self.path, "|".join(("probe", *map(stem_of, self.files))))
                remove_leftovers(self.views, rf"probe|\d+_(?:{'|'.join(_PICTURES)})")
                yield
        finally:
            with contextlib.suppress(OSError):
                for folder in absent:
                    folder.rmdir()

    @contextmanager
    def occupied(self, options: dict[str, Any], *, overwrite: bool, begun: Callable[[], bool]) -> Iterator[None]:
        """Context manager for what a run leaves in the claimed folder; writes the options.

        When the body raises an error before a new run has begun, everything that this call or the body left is taken
        back, so that the next attempt finds the folder free.

        Args:
            options: Of the run, as JSON values.
            overwrite: Remove the files of a run in it first; others are left alone.
            begun: Whether the run has got anywhere that is worth keeping.

        Raises:
            FitError: The folder cannot be emptied, or the options cannot be written.
        """
        is_new = overwrite or not self.holds_run()
        try:
            if overwrite:
                self._clear()
            write_json(self.config, options)
            yield
        except Exception:
            if is_new and not begun():
                self._withdraw()
            raise

    def _clear(self) -> None:
        try:
            for path in self.files[:-1]:
                path.unlink(missing_ok=True)
            for kind in _PICTURES:
                for picture in self.views.glob(f"*_{kind}.png"):
                    picture.unlink()
            for events in self.logs.glob("events.out.tfevents.*"):
                events.unlink()
            self.files[-1].unlink(missing_ok=True)
        except OSError as error:
            raise self._unusable(error) from error

    def _withdraw(self) -> None:
        """Removes the start of a run."""
        with contextlib.suppress(OSError):
            self.checkpoint.unlink(missing_ok=True)
            self.config.unlink(missing_ok=True)

    def _unusable(self, error: OSError) -> FitError:
        return FitError(f"The folder {self.path} cannot be used ({error.strerror}); choose another.")


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Writes JSON, whole or not at all.

    Raises:
        FitError: The file cannot be written.
    """
    with atomic_write(path, FitError) as temporary:
        temporary.write_text(json.dumps(values, indent=2) + "\n")
