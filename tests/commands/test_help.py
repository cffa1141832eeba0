"""What the command line tells before anything runs: help, versions, and what is wrong with arguments."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
import tyro
from commands.helpers import fails

import difftetvr
import difftetvr.cli as cli
from difftetvr.cli.help import options_of

HEAVY = ("torch", "drjit", "scipy", "matplotlib", "meshio", "PIL")


@pytest.mark.parametrize(
    "args",
    [
        ["--help"],
        ["--version"],
        ["fit", "--help"],
        ["paint"],
        ["fit", "tooth"],
        ["fit", "tooth", "-o", "x", "--cells", "many"],
        ["render", "a.vtu", "-o", "a.png", "--background", "grey"],
    ],
    ids=" ".join,
)
def test_nothing_heavy_is_imported_before_a_command_runs(args):
    code = f"""
import sys
sys.path.insert(0, {str(Path(cli.__file__).parents[2])!r})
from difftetvr.cli import main
code = main({args!r})
print(code, sorted(set({HEAVY!r}) & sys.modules.keys()))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    expected = 0 if "help" in args[-1] or "version" in args[-1] else 2
    assert done.stdout.splitlines()[-1] == f"{expected} []", done.stdout + done.stderr


def test_the_version_is_the_packages(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"difftetvr {difftetvr.__version__}\n"


def test_the_overview_names_every_command_and_what_it_does(capsys):
    assert cli.main(["--help"]) == 0
    shown = capsys.readouterr().out
    for name in cli.COMMANDS:
        assert re.search(rf"^  {name} +[A-Z]", shown, re.MULTILINE), name
    assert cli.main([]) == 2 and capsys.readouterr().out == shown


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_help_shows_the_options_that_the_parser_takes(name, capsys):
    kind = cli.command_type(name)
    with pytest.raises(SystemExit):
        tyro.cli(kind, args=["--help"], config=(tyro.conf.FlagCreatePairsOff,))
    told = re.sub(r"\x1b\[[\d;]*m", "", capsys.readouterr().out)
    # An option stands at the beginning of a line, in a box or not, its description two blanks or more to the right.
    taken = {flag for line in re.findall(r"^[│ ] (-[a-z-].*?)(?:  .*)?$", told, re.MULTILINE) for flag in _flags(line)}
    shown = {flag for option in options_of(kind) for flag in _flags(option.flags)}
    assert shown == taken - {"--help"} and (shown or name == "doctor")


def _flags(text):
    return re.findall(r"(?<![\w-])--[a-z][\w.-]*", text)


@pytest.mark.parametrize("name", cli.COMMANDS)
@pytest.mark.parametrize("width", [60, 80, 140])
def test_help_wraps_to_the_terminal_and_has_no_noise(name, width, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(width))
    assert cli.main([name, "--help"]) == 0
    shown = capsys.readouterr().out
    long = [line for line in shown.splitlines() if len(line.rstrip()) > width]
    assert not [line for line in long if " " in line.strip()], "only single words may be wider"
    assert "None" not in shown and "{" not in shown and "MISSING" not in shown
    assert all(option.text for option in options_of(cli.command_type(name))), "an option without a description"


def test_help_of_fit_shows_ten_options_before_the_rest_and_groups_these(capsys):
    assert cli.main(["fit", "--help"]) == 0
    sections = re.split(r"\n\n(?=\w)", capsys.readouterr().out)
    titles = [section.splitlines()[0].strip() for section in sections[2:]]
    assert titles[:2] == ["Arguments", "Most used"]
    assert {"Mesh", "Motion", "Refinement", "Output"} <= set(titles) and "Options" not in titles
    most_used = next(section for section in sections if section.startswith("Most used"))
    assert len(re.findall(r"^  -", most_used, re.MULTILINE)) == 10


def test_help_of_a_file_tells_its_values(tmp_path, capsys):
    (tmp_path / "config.json").write_text('{"fit": {"cells": 777, "move": false}}')
    assert cli.main(["fit", "--config", str(tmp_path / "config.json"), "--help"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "(default: 777)" in shown or "Default: 20 000" in shown
    assert re.search(r"--move, --no-move Whether vertices move. \(default: off\)", shown)


def test_mistyped_commands_get_the_one_that_is_meant(capsys):
    assert "is it 'render'?" in fails_with(capsys, "rendr")
    assert "give one of fit, mesh, render" in fails_with(capsys, "zzz")


def fails_with(capsys, *args):
    assert cli.main(list(args)) == 2
    return capsys.readouterr().err


def test_numbers_that_are_none_are_told_plainly(capsys):
    assert cli.main(["fit", "tooth", "-o", "x", "--cells", "many"]) == 2
    error = capsys.readouterr().err
    assert "--cells" in error and "'many'" in error and "{None}" not in error and "NoneType" not in error


@pytest.mark.parametrize("name", ["render", "compare", "cut", "eval", "fit"])
def test_backgrounds_have_one_spelling_everywhere(name):
    kind = cli.command_type(name)
    given = {"fit": ["tooth", "-o", "x"], "compare": ["tooth", "a.vtu", "-o", "a.png"], "eval": ["a.vtu", "tooth"]}
    args = given.get(name, ["a.vtu", "-o", "a.png"])
    for words, value in ((["white"], "white"), (["0.5", "0", "1"], (0.5, 0.0, 1.0))):
        command = cli.parse_command([name, *args, "--background", *words])
        assert isinstance(command, kind)
        assert (command.config if name == "fit" else command).background == value


def test_doctor_tells_versions_back_ends_and_the_error_of_a_test_image(capsys):
    assert cli.main(["doctor"]) == 0
    shown = capsys.readouterr().out
    assert f"difftetvr {difftetvr.__version__}" in shown and "LLVM" in shown and "threads" in shown
    errors = [float(value) for value in re.findall(r"off by ([\d.e+-]+)", shown)]
    assert errors and all(0 < error < 1e-4 for error in errors)


def test_doctor_finds_a_back_end_that_renders_wrongly(capsys, monkeypatch):
    from difftetvr.cli import doctor

    right = doctor._sample

    def wrong(device, dtype):
        image, *gradients = right(device, dtype)
        return [image + (0.01 if str(dtype) == "torch.float32" else 0.0), *gradients]

    monkeypatch.setattr(doctor, "_sample", wrong)
    assert "renders wrongly" in fails(capsys, "doctor")


def test_doctor_says_what_to_do_where_nothing_starts(capsys, monkeypatch):
    import difftetvr.backend as backend
    from difftetvr.errors import BackendError

    def missing(device, dtype=None):
        raise BackendError(backend._missing_backend(backend._DEVICE_BACKENDS[device]))

    monkeypatch.setattr(backend, "get_backend", missing)
    assert "libLLVM" in fails(capsys, "doctor")
