"""Options that a command line for ``difftetvr fit`` need not give: those of a file, or of the run to go on with."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro
from tyro.conf import FlagCreatePairsOff, arg

from difftetvr.cli.options import CaptureOptions
from difftetvr.errors import DiffTetError, FitError
from difftetvr.fitting.config import FitConfig
from difftetvr.fitting.options import options_from_json
from difftetvr.fitting.records.folder import RunFolder
from difftetvr.trust import require_regular

_Saved = TypeVar("_Saved")
_LEFT_OPEN: dict[str, Any] = {"capture": None, "capture_options": {}, "fit": {}}


@dataclass(frozen=True)
class SavedRun:
    """What a run's config.json holds.

    Attributes:
        capture: Name of the capture; None: left open.
        capture_options: How it is read.
        fit: How it is fitted.
        repair: What mending the initial mesh changed, in words; for the reader.
    """

    capture: str | None
    capture_options: CaptureOptions
    fit: FitConfig
    repair: str | None = None

    def is_of(self, capture: str | None) -> bool:
        """Whether the run fits the capture of a name, which may be another path of the same files; None: any."""
        if self.capture is None or capture is None:
            return self.capture is not None
        return os.path.realpath(self.capture) == os.path.realpath(capture)

    @staticmethod
    def in_folder(folder: RunFolder) -> SavedRun | None:
        """The run in a folder; None if it holds none.

        Raises:
            FitError: The file is damaged.
        """
        return saved_options(folder, SavedRun)

    @staticmethod
    def in_file(path: Path) -> SavedRun:
        """What a file says, and the defaults of all that it does not.

        Raises:
            FitError: There is no such file, or it is damaged.
        """
        if path.is_dir():
            raise FitError(f"--config cannot use {path}: It is a folder; give a file, such as {path / 'config.json'}.")
        require_regular(path, FitError)
        folder = RunFolder(path.parent)
        if path.name == folder.config.name and is_of_scan(folder):
            raise FitError(
                f"--config cannot use {path}: It is of a run on projections, whose options are given by name."
            )
        return _read(path, SavedRun, _LEFT_OPEN, f"--config cannot use {path}")


@dataclass(frozen=True)
class _Origin:
    """The options that say where the others come from, and so have to be known before those are parsed."""

    output: Annotated[Path | None, arg(aliases=["-o"])] = None
    config: Path | None = None
    resume: bool = False


def saved_run(args: Sequence[str]) -> SavedRun | None:
    """The options that stand for those which the arguments of ``difftetvr fit`` do not give; None if there are none.

    Raises:
        FitError: They cannot be read, or there are two places to take them from.
    """
    origin = _origin_of(args)
    if origin.config is not None:
        if origin.resume:
            raise FitError("--resume goes on with the options of the run itself; leave out --config, or --resume.")
        return SavedRun.in_file(origin.config)
    return options_to_resume(args, SavedRun)


def options_to_resume(args: Sequence[str], kind: type[_Saved]) -> _Saved | None:
    """What the config.json of the run holds that arguments ask to go on with; None where there is none.

    Args:
        args: The arguments.
        kind: Dataclass of what it is to hold.

    Raises:
        FitError: The file is damaged.
    """
    folder = folder_to_resume(args)
    return None if folder is None else saved_options(folder, kind)


def folder_to_resume(args: Sequence[str]) -> RunFolder | None:
    """The folder of the run that the arguments of ``difftetvr fit`` ask to go on with; None if they ask for none."""
    origin = _origin_of(args)
    return RunFolder(origin.output) if origin.resume and origin.output is not None else None


def goes_on_with(options: str, args: Sequence[str]) -> bool:
    """Whether arguments of ``difftetvr fit`` ask to go on with a run whose config.json has options of a kind.

    Args:
        options: Name of these options there.
        args: The arguments.
    """
    try:
        folder = folder_to_resume(args)
    except (OSError, ValueError, TypeError):
        return False
    return folder is not None and _has_options(folder, options)


def is_of_scan(folder: RunFolder) -> bool:
    """Whether a folder holds a run that reconstructed from projections."""
    return _has_options(folder, "tomography")


def _has_options(folder: RunFolder, options: str) -> bool:
    try:
        return options in json.loads(folder.config.read_bytes())
    except (OSError, ValueError, TypeError, RecursionError):
        return False  # What is wrong with the file is said when it is read.


def _origin_of(args: Sequence[str]) -> _Origin:
    try:
        origin, _ = tyro.cli(
            _Origin,
            args=args,
            return_unknown_args=True,
            add_help=False,
            console_outputs=False,
            config=(FlagCreatePairsOff,),
        )
    except SystemExit:
        return _Origin()  # What is wrong with the arguments is said when all of them are parsed.
    return origin


def saved_beside(model: Path) -> SavedRun | None:
    """The run that a model is the result of; None where it does not lie in the folder of one, or that is damaged."""
    folder = RunFolder(model.parent)
    if model.name != folder.model.name:
        return None
    try:
        return SavedRun.in_folder(folder)
    except DiffTetError:
        return None


def run_behind(model: Path, capture: str | None) -> SavedRun | None:
    """The run that a model is the result of, if it fits the capture of a name; None where that is not known.

    Args:
        model: The model's file.
        capture: Name of the capture; None: whichever it is.
    """
    run = saved_beside(model)
    return run if run is not None and run.is_of(capture) else None


def saved_options(folder: RunFolder, kind: type[_Saved]) -> _Saved | None:
    """What the config.json of the run in a folder holds; None if it holds no run.

    Args:
        folder: The folder.
        kind: Dataclass of what it is to hold.

    Raises:
        FitError: The file is damaged.
    """
    if not folder.config.is_file():
        return None
    refusal = f"--resume cannot use {folder.config} (start anew with --overwrite, or mend it)"
    return _read(folder.config, kind, {}, refusal)


def _read(path: Path, kind: type[_Saved], base: dict[str, Any], refusal: str) -> _Saved:
    """A run's options from JSON.

    Args:
        path: The file.
        kind: Dataclass of what it is to hold.
        base: Values of what the file leaves out; all else that has no default must be in it.
        refusal: Says who cannot use the file, and what to do; what is wrong with it is added.
    """
    try:
        values = json.loads(path.read_bytes())
    except FileNotFoundError as error:
        raise FitError(f"{refusal}: There is no such file; check the path.") from error
    except OSError as error:
        raise FitError(f"{refusal}: It cannot be read ({error.strerror}); check its permissions.") from error
    except (ValueError, RecursionError) as error:
        raise FitError(f"{refusal}: It is no JSON ({error}); correct it there.") from error
    try:
        return options_from_json(kind, base | values if isinstance(values, dict) else values)
    except DiffTetError as error:
        raise FitError(f"{refusal}: {error}") from error
