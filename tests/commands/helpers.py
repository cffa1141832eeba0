"""What the tests of the commands share."""

import importlib
import re

import difftetvr.cli as cli

LOOP = importlib.import_module("difftetvr.fitting.loop")
TRAINER = importlib.import_module("difftetvr.fitting.trainer")
VIEWS = ["--views", "10", "--width", "24", "--height", "24"]
FEW_ROUNDS = ["--exchange.rounds", "1", "--exchange.views", "3"]
FIT = ["--cells", "500", "--iterations", "4", *FEW_ROUNDS, "--device", "cpu"]


def fails(capsys, *args):
    """Asserts exit code 2 and one sentence on standard error; returns it."""
    capsys.readouterr()
    assert cli.main([str(a) for a in args]) == 2
    error = capsys.readouterr().err
    assert re.fullmatch(r"difftetvr: [^\n]+\.\n", error), error
    assert "Traceback" not in error
    return error


def raising(error):
    """A function that raises an error, whatever it is called with."""

    def fail(*args, **kwargs):
        raise error

    return fail
