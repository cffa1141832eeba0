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
@pytest.mark.parametrize("width", [40, 60, 80, 140])
def test_help_wraps_to_the_terminal_and_has_no_noise(name, width, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(width))
    assert cli.main([name, "--help"]) == 0
    shown = capsys.readouterr().out
    long = [line for line in shown.splitlines() if len(line.rstrip()) > width]
    assert not [line for line in long if " " in line.strip()], "only single words may be wider"
    assert "…" not in shown, "text is cut off"
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


@pytest.mark.parametrize("option", ["--background", "--grid"])
def test_options_before_positional_arguments_leave_these_alone(option):
    words = {"--background": ["1", "0", "0.5"], "--grid": ["4", "3", "2"]}[option]
    for given in (words, ["white"] if option == "--background" else words):
        command = cli.parse_command(["fit", option, *given, "tooth", "--seed", "3", "-o", "x"])
        assert command.capture == "tooth" and command.config.seed == 3
    command = cli.parse_command(["compare", "tooth", "--background", "white", "a.vtu", "b.vtu", "-o", "p.png"])
    assert [path.name for path in command.models] == ["a.vtu", "b.vtu"] and command.background == "white"
    command = cli.parse_command(
        ["render", "--eye", "1", "-2", "3", "--background", "1", "1", "1", "a.vtu", "-o", "p.png"]
    )
    assert (
        command.view_from.eye == (1.0, -2.0, 3.0)
        and command.background == (1.0, 1.0, 1.0)
        and command.model.name == "a.vtu"
    )


def test_none_leaves_options_of_every_type_open():
    words = [
        "--device",
        "--initial-mesh",
        "--transfer-function",
        "--cells",
        "--grid",
        "--start",
        "--background",
        "--bounds",
    ]
    command = cli.parse_command(["fit", "tooth", "-o", "x", *(word for name in words for word in (name, "None"))])
    config, views = command.config, command.views_of
    assert (config.device, config.initial_mesh, config.cells, config.grid, config.start) == (None,) * 5
    assert (config.background, views.transfer_function, views.bounds) == (None,) * 3
    assert cli.parse_command(["eval", "a.vtu", "tooth", "-o", "None"]).output is None


def test_help_is_there_for_whoever_names_a_wrong_file(tmp_path, capsys):
    assert cli.main(["fit", "--config", str(tmp_path / "missing.json"), "--help"]) == 0
    assert "--cells N" in capsys.readouterr().out


def test_usage_shows_what_must_be_given(capsys):
    assert cli.main(["mesh", "--help"]) == 0
    assert capsys.readouterr().out.startswith("usage: difftetvr mesh [SOURCE] -o FILE [OPTIONS]\n")


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


def test_doctor_goes_on_where_a_back_end_breaks(capsys, monkeypatch):
    import difftetvr.backend as backend
    from difftetvr.cli import doctor

    def broken(*args):
        raise RuntimeError("the driver\nis broken")

    monkeypatch.setattr(doctor, "_sample", broken)
    assert cli.main(["doctor"]) == 2
    said = capsys.readouterr()
    assert (
        "a test image fails: the driver is broken" in said.out and "metal:" in said.out and "Traceback" not in said.err
    )
    monkeypatch.setattr(backend, "_description", broken)
    assert cli.main(["doctor"]) == 2
    assert "llvm:     the driver is broken" in capsys.readouterr().out


def test_doctor_says_what_to_do_where_nothing_starts(capsys, monkeypatch):
    import difftetvr.backend as backend
    from difftetvr.errors import BackendError

    def missing(device, dtype=None):
        raise BackendError(backend._missing_backend(backend._DEVICE_BACKENDS[device]))

    monkeypatch.setattr(backend, "get_backend", missing)
    assert "libLLVM" in fails(capsys, "doctor")
