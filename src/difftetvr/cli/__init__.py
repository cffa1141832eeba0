"""The command line: ``difftetvr fit | mesh | render | compare | cut | eval | info | export | ...``, see `COMMANDS`.

PyTorch takes seconds to import, so only a command that runs does it: help, versions and mistyped arguments do not. All
else that takes its time is imported by `main`, not with this module: only there does an interrupt end in good order.
"""

from __future__ import annotations

import contextlib
import difflib
import importlib
import os
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from difftetvr._version import __version__
from difftetvr.errors import DiffTetError, FitError
from difftetvr.interrupts import INTERRUPTED, OrderlyExit

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["COMMANDS", "command_type", "console", "main", "parse_command"]

_USAGE_ERROR = 2
_HELP = ("-h", "--help")
_LAUNCHED = "TORCHELASTIC_RUN_ID"  # a variable of processes that torchrun has started

COMMANDS = {
    "fit": "fit.Fit",
    "mesh": "mesh.Mesh",
    "render": "render.Render",
    "view": "live.view.View",
    "compare": "pictures.Compare",
    "cut": "pictures.Cut",
    "fit-transfer": "inverse.fit_transfer.FitTransfer",
    "viewpoint": "inverse.viewpoint.Viewpoint",
    "eval": "files.Eval",
    "info": "files.Info",
    "export": "export.command.Export",
    "project": "project.Project",
    "voxelise": "export.voxelise.Voxelise",
    "doctor": "doctor.Doctor",
}
"""Modules and dataclasses of the commands, within this package."""


def command_type(name: str) -> type:
    """The dataclass of a command.

    Raises:
        FitError: There is no such command.
    """
    if name not in COMMANDS:
        alike = difflib.get_close_matches(name, COMMANDS, 1)
        hint = f"; is it '{alike[0]}'?" if alike else f"; give one of {', '.join(COMMANDS)}."
        raise FitError(f"There is no command '{name}'{hint}")
    module, _, kind = COMMANDS[name].rpartition(".")
    found: type = getattr(importlib.import_module(f"difftetvr.cli.{module}"), kind)
    return found


def parse_command(args: Sequence[str]) -> Any:
    """The command that arguments describe, ready to run.

    Args:
        args: Arguments after the program's name.

    Raises:
        FitError: There is no such command, an argument is not valid, or a file that options come from cannot be read.
    """
    from difftetvr.cli.parsing import parse

    kind = _variant(command_type(args[0]), args[1:])
    return parse(kind, args[0], args[1:], _saved(kind, args[1:]))


def main(args: Sequence[str] | None = None) -> int:
    """Runs a command.

    Args:
        args: Arguments after the program's name; default: those of the process.

    Returns:
        The exit code: 0, 2 for bad input (one sentence on standard error), 130 when interrupted.
    """
    with OrderlyExit(patient=_LAUNCHED in os.environ) as signals:
        try:
            return _main(list(sys.argv[1:] if args is None else args))
        except KeyboardInterrupt:
            return INTERRUPTED
        except Exception:
            if signals.raised:  # Compiled code has made another error of the interrupt.
                return INTERRUPTED
            raise


def console() -> Console:
    """Where commands print, see `difftetvr.terminal.console`."""
    from difftetvr import terminal

    return terminal.console()


def _main(given: Sequence[str]) -> int:
    from difftetvr.terminal import complain, finish, plain_warnings, sentence_for

    try:
        with plain_warnings():
            out = console()
            if not _tell(out, given):
                _run(out, given)
            finish()
    except SystemExit as leave:
        return leave.code if isinstance(leave.code, int) else _USAGE_ERROR
    except Exception as error:
        sentence = sentence_for(error)
        if sentence is None:
            raise
        complain(sentence)
        return _USAGE_ERROR
    return 0 if given else _USAGE_ERROR


def _run(out: Console, given: Sequence[str]) -> None:
    """Runs the command that arguments describe."""
    from difftetvr.cli.options import TrustOptions
    from difftetvr.terminal import waiting
    from difftetvr.trust import trusting

    is_follower = _LAUNCHED in os.environ and os.environ.get("RANK") != "0"
    try:
        command = parse_command(given)
    except DiffTetError as error:
        if is_follower:  # The first of the processes is told the same, and says so.
            raise SystemExit(_USAGE_ERROR) from error
        raise
    if out.is_terminal and not is_follower:
        with waiting(out, "Loading PyTorch"):
            importlib.import_module("torch")
    trust = getattr(command, "trust", TrustOptions())
    with trusting(trust.allow_outside, trust.allow_large):
        command.run(out)


def _tell(out: Console, given: Sequence[str]) -> bool:
    """Prints what arguments ask to be told without running anything; whether they did, as no arguments do."""
    if given[:1] == ["--version"]:
        out.print(f"difftetvr {__version__}")
    elif not given or given[0] in _HELP:
        from difftetvr.cli.help import print_overview  # commands that run need no help

        print_overview(out, {name: command_type(name) for name in COMMANDS})
    elif any(word in _HELP for word in given[1:]):
        from difftetvr.cli.help import print_help

        words = [word for word in given[1:] if word not in _HELP]
        kind = _variant(command_type(given[0]), words)
        saved = None
        with contextlib.suppress(DiffTetError):  # help is there for whoever names the wrong file, too
            saved = _saved(kind, words)
        print_help(out, given[0], kind, saved)
    else:
        return False
    return True


def _variant(kind: Any, args: Sequence[str]) -> Any:
    """The dataclass of a command for its arguments, where there are several by what these name."""
    return kind.variant(args) if hasattr(kind, "variant") else kind


def _saved(kind: Any, args: Sequence[str]) -> Any:
    """What stands for options that are not given, where a command takes them from a file."""
    return kind.defaults(args) if hasattr(kind, "defaults") else None
