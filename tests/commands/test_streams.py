"""Where commands print: terminals that obey codes, pipes that close, full disks, widths that no layout fits."""

import io
import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
from rich.console import Console
from rich.table import Table
from rich.text import Text

import difftetvr.cli as cli
from difftetvr.capture import CaptureWarning
from difftetvr.terminal import complain, console, plain_warnings, printable, waiting

EVIL = "\x1b]0;title\x07\x1b[31mred\x9b2J\u202etxt\r\x08\x7f"
HARMLESS = "zähne 牙　齒 🦷 a\u200db"


def test_text_keeps_all_characters_but_those_that_terminals_obey():
    assert printable(f"{HARMLESS}\nline") == f"{HARMLESS}\nline"
    assert printable(EVIL) == r"\x1b]0;title\x07\x1b[31mred\x9b2J\u202etxt\r\x08\x7f"
    assert printable("\udcff") == r"\udcff"


def shown(monkeypatch, show, is_terminal):
    """What a function prints on a console, as bytes that a terminal would get."""
    stream = io.StringIO()
    stream.isatty = lambda: is_terminal
    monkeypatch.setattr(sys, "stdout", stream)
    monkeypatch.setenv("TERM", "xterm-256color")
    show(console())
    return stream.getvalue()


@pytest.mark.parametrize("is_terminal", [False, True])
def test_names_send_no_codes_however_they_are_printed(monkeypatch, is_terminal):
    def show(out):
        table = Table(title=Text(EVIL))
        table.add_column(EVIL)
        table.add_row(EVIL, Text(EVIL))
        out.print(table)
        out.print(EVIL, EVIL, style="bold")
        out.print(Text(EVIL))
        with waiting(out, EVIL):
            pass

    said = shown(monkeypatch, show, is_terminal)
    assert not {"\x07", "\x9b", "\u202e", "\x08"} & set(said)
    assert "\x1b]0" not in said and "\x1b[31m" not in said and r"\x1b[31mred" in said
    assert ("\x1b[1m" in said) == is_terminal, "styles of our own are shown on terminals"


@pytest.mark.parametrize("columns", ["0", "1", "5", "-1", "abc", "", "100000", "9" * 30])
@pytest.mark.parametrize("args", [["--help"], ["info", "--help"]], ids=" ".join)
def test_help_fits_whatever_the_environment_calls_a_width(monkeypatch, capsys, columns, args):
    monkeypatch.setenv("COLUMNS", columns)
    monkeypatch.setenv("LINES", columns)
    assert cli.main(args) == 0
    said = capsys.readouterr().out
    assert "difftetvr" in said and len(said) < 20_000


def test_the_width_is_that_of_the_terminal_where_it_will_do(monkeypatch):
    monkeypatch.setenv("COLUMNS", "64")
    assert console().width == Console().width == 64


def test_warnings_are_sentences_without_codes(capsys):
    with plain_warnings():
        warnings.warn(CaptureWarning(f"a{EVIL}"), stacklevel=1)
        warnings.warn(f"b{EVIL}", stacklevel=1)
    said = capsys.readouterr().err
    assert said.startswith(r"difftetvr: a\x1b]0") and "UserWarning: b" in said and "\x1b" not in said
    complain("one\nline")
    assert capsys.readouterr().err == "difftetvr: one\\nline\n"


def piped(args, **streams):
    """Exit code and standard error of the command line; a pipe that nobody reads for `stdout=None`."""
    environment = {**os.environ, "PYTHONPATH": str(Path(cli.__file__).parents[2])}
    process = subprocess.Popen(
        [sys.executable, "-m", "difftetvr", *args], env=environment, stderr=subprocess.PIPE, text=True, **streams
    )
    if process.stdout is not None:
        process.stdout.close()
    error = process.communicate()[1]
    return process.returncode, error


def test_a_pipe_that_closes_is_no_error():
    assert piped(["fit", "--help"], stdout=subprocess.PIPE) == (0, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no disk that is always full")
def test_a_full_disk_is_one_sentence():
    with open("/dev/full", "w") as full:
        assert piped(["--version"], stdout=full) == (2, "difftetvr: No space left on device.\n")


def test_what_is_printed_after_a_pipe_has_closed_goes_nowhere(monkeypatch):
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as pipe:
        monkeypatch.setattr(sys, "stdout", pipe)
        out = console()
        for _ in range(3):
            out.print("x" * 100_000)
        out.file.flush()


@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_processes_without_streams_run_as_well(monkeypatch, stream):
    monkeypatch.setattr(sys, stream, None)
    assert cli.main(["--version"]) == 0
    assert cli.main(["paint"]) == 2
