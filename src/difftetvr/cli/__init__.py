"""The command line: ``difftetvr fit | mesh | render | compare | cut | eval | info | export``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Annotated, Any

from tyro.conf import subcommand

from difftetvr.cli.files import Eval, Export, Info
from difftetvr.cli.fit import Fit
from difftetvr.cli.mesh import Mesh
from difftetvr.cli.options import CaptureOptions, parse
from difftetvr.cli.pictures import Compare, Cut
from difftetvr.cli.render import Render
from difftetvr.terminal import console, sentence_for

__all__ = ["CaptureOptions", "Compare", "Cut", "Eval", "Export", "Fit", "Info", "Mesh", "Render", "main"]

_USAGE_ERROR = 2
_INTERRUPTED = 130

Command = (
    Annotated[Fit, subcommand("fit")]
    | Annotated[Mesh, subcommand("mesh")]
    | Annotated[Render, subcommand("render")]
    | Annotated[Compare, subcommand("compare")]
    | Annotated[Cut, subcommand("cut")]
    | Annotated[Eval, subcommand("eval")]
    | Annotated[Info, subcommand("info")]
    | Annotated[Export, subcommand("export")]
)


def main(args: Sequence[str] | None = None) -> int:
    """Runs a command.

    Args:
        args: Arguments after the program's name; default: those of the process.

    Returns:
        The exit code: 0, 2 for bad input (one sentence on standard error), 130 when interrupted.
    """
    given = list(sys.argv[1:] if args is None else args)
    try:
        command: Any = parse(Command, given, Fit.defaults(given[1:]) if given[:1] == ["fit"] else None)
        command.run(console())
    except SystemExit as leave:
        return leave.code if isinstance(leave.code, int) else _USAGE_ERROR
    except KeyboardInterrupt:
        return _INTERRUPTED
    except Exception as error:
        sentence = sentence_for(error)
        if sentence is None:
            raise
        print(f"difftetvr: {sentence}", file=sys.stderr)
        return _USAGE_ERROR
    return 0
