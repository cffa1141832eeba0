"""Options that `difftetvr fit` takes from a file: those of --config, and those of the run to --resume."""

import json
import shutil

import pytest
from commands.helpers import FIT, VIEWS, fails

import difftetvr.cli as cli


def config_of(folder):
    return json.loads((folder / "config.json").read_text())


def written(path, content):
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def parsed(*args):
    """The command that the program would run."""
    command = [str(a) for a in args]
    return cli.parse_command(command)


@pytest.fixture
def still(tmp_path):
    """Options of a run with flags that are turned from their defaults, and without those chosen for its images."""
    fit = {"cells": 600, "harmonics": None, "move": False, "deterministic": False, "exchange": {"flips": False}}
    content = {"capture": "tooth", "capture_options": {"views": 10, "bounds": None}, "fit": fit, "repair": "nothing"}
    return written(tmp_path / "still.json", content)


def test_a_run_starts_anew_from_its_own_options(run, tmp_path):
    assert cli.main(["fit", "--config", str(run / "config.json"), "-o", str(tmp_path / "again")]) == 0
    assert config_of(tmp_path / "again") == config_of(run)
    assert (tmp_path / "again" / "model.vtu").read_bytes() == (run / "model.vtu").read_bytes()


def test_a_run_may_be_replaced_by_itself(run, tmp_path):
    folder = tmp_path / "out"
    shutil.copytree(run, folder)
    config = folder / "config.json"
    assert cli.main(["fit", "--config", str(config), "-o", str(folder), "--overwrite", "--iterations", "2"]) == 0
    assert config_of(folder) == config_of(run) | {"fit": config_of(run)["fit"] | {"iterations": 2}}


def test_a_file_by_hand_says_as_little_as_it_likes(tmp_path):
    fit = {"cells": 500, "iterations": 2, "device": "cpu", "exchange": {"rounds": 2, "boundary": "fixed"}}
    config = written(tmp_path / "few.json", {"fit": fit})
    assert cli.main(["fit", "tooth", "--config", str(config), "-o", str(tmp_path / "out"), *VIEWS]) == 0
    saved = config_of(tmp_path / "out")
    assert (saved["capture"], saved["capture_options"]["views"]) == ("tooth", 10)
    assert saved["fit"].items() >= {"cells": 500, "iterations": 2, "batch_views": 1, "harmonics": 0}.items()
    assert saved["fit"]["exchange"].items() >= {"rounds": 2, "boundary": "fixed", "share": 0.08}.items()


def test_what_is_left_out_keeps_its_default(tmp_path):
    out = tmp_path / "out"
    assert parsed("fit", "tooth", "--config", written(tmp_path / "a.json", {}), "-o", out).to_json() == (
        parsed("fit", "tooth", "-o", out).to_json()
    )
    options = parsed("fit", "--config", written(tmp_path / "b.json", {"capture": "scan.nrrd"}), "-o", out)
    assert options.to_json() == parsed("fit", "scan.nrrd", "-o", out).to_json()


def test_the_command_line_wins(still, tmp_path):
    command = ["fit", "--config", still, "-o", tmp_path]
    fit = parsed(*command)
    assert (fit.capture, fit.views_of.views, fit.config.cells, fit.config.harmonics) == ("tooth", 10, 600, None)
    assert not (fit.config.move or fit.config.deterministic or fit.config.exchange.flips or fit.resume or fit.overwrite)
    other = parsed(*command, "scan.nrrd", "--views", 12, "--cells", "900", "--move", "--exchange.flips", "--width", 8)
    assert (other.capture, other.views_of.views, other.views_of.width) == ("scan.nrrd", 12, 8)
    assert (other.config.cells, other.config.move, other.config.exchange.flips) == (900, True, True)
    assert not other.config.deterministic
    assert parsed(*command, "--no-move").config == fit.config


def test_options_that_only_hold_together_with_those_of_the_file(tmp_path, capsys):
    config = written(tmp_path / "flat.json", {"capture": "tooth", "fit": {"refine": "none", "grid": [2, 2, 2]}})
    command = ["fit", "--config", config, "-o", tmp_path / "out"]
    assert parsed(*command, "--location", "cell").config.grid == (2, 2, 2)
    mended = parsed(*command, "--grid", "None", "--initial-mesh", "a.vtu", "--repair").config
    assert (mended.grid, mended.initial_mesh) == (None, "a.vtu")
    assert "left out with an initial mesh" in fails(capsys, *command, "--initial-mesh", "a.vtu")


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ({"fitt": {}}, "There is no option 'fitt'; correct its name (is it 'fit'?) or remove it."),
        ({"fit": {"xyz": 3}}, "There is no option 'fit.xyz'; correct its name or remove it."),
        ({"fit": {"motion": {"limits": {"qualty": 0}}}}, "There is no option 'fit.motion.limits.qualty'; "),
        ({"capture_options": {"widht": 3}}, "There is no option 'capture_options.widht'; "),
        ({"fit": {"exchange": {"prefix": "a"}}}, "There is no option 'fit.exchange.prefix'; "),
        ({"capture": 3}, "The option capture is 3; it must be a text or null."),
        ({"repair": True}, "The option repair is True; it must be a text or null."),
        ({"fit": {"iterations": "many"}}, "The option fit.iterations is 'many'; it must be a whole number or null."),
        (
            {"fit": {"exchange": {"rounds": 2.5}}},
            "The option fit.exchange.rounds is 2.5; it must be a whole number or null.",
        ),
        ({"fit": {"grid": [1, 2]}}, "it must be [a whole number, a whole number, a whole number] or null."),
        ({"fit": {"loss": "l3"}}, """The option fit.loss is 'l3'; it must be "l2" or "l1" or "l1-ssim"."""),
        ({"fit": {"move": None}}, "The option fit.move is None; it must be true or false."),
        ({"fit": {"rate": 10**400}}, "it must be a number."),
        ({"fit": [3]}, "The option fit is no JSON object; "),
        ([3], "The options are no JSON object; "),
        ({"fit": {"iterations": 0}}, "The option iterations is 0; it must be at least 1 and at most "),
        ({"fit": {"exchange": {"share": 2}}}, "The option exchange.share is 2; it must be at least 0 and below 1."),
        ({"fit": {"motion": {"limits": {"quality": 3}}}}, "quality=3, halvings=6) is out of range; "),
        ('{"fit": {"cells": 3}', "It is no JSON (Expecting ',' delimiter: line 1 column 21 (char 20)); correct it"),
        ("[" * 10**5, "It is no JSON ("),
        ('{"fit": {"grid": ' + "[" * 400 + "]" * 400 + "}}", "The option fit.grid is [[[[[["),
    ],
    ids=lambda value: str(value)[:40],
)
def test_damaged_files_are_one_sentence(tmp_path, capsys, content, complaint):
    path = written(tmp_path / "options.json", content)
    said = fails(capsys, "fit", "tooth", "--config", path, "-o", tmp_path / "out")
    assert said.startswith(f"difftetvr: --config cannot use {path}: ")
    assert complaint in said
    assert "--overwrite" not in said
    assert [p.name for p in tmp_path.iterdir()] == ["options.json"]


def test_files_that_are_none(run, tmp_path, capsys):
    out = tmp_path / "out"
    missing = tmp_path / "nothing.json"
    assert f"cannot use {missing}: There is no such file" in fails(capsys, "fit", "--config", missing, "-o", out)
    assert f"a file, such as {run}/config.json" in fails(capsys, "fit", "tooth", "--config", run, "-o", out)
    (tmp_path / "noise").write_bytes(b"\xff\x00\xfe")
    assert "noise: It is no JSON (" in fails(capsys, "fit", "tooth", "--config", tmp_path / "noise", "-o", out)
    assert not out.exists()


def test_one_place_to_take_options_from(run, tmp_path, capsys):
    said = fails(capsys, "fit", "tooth", "-o", run, "--resume", "--config", run / "config.json")
    assert "leave out --config, or --resume" in said


@pytest.mark.parametrize("options", [[], ["--resume"], ["--config", "CONFIG"]])
def test_a_capture_that_nothing_names_is_a_usage_error(tmp_path, capsys, options):
    config = written(tmp_path / "fit.json", {"fit": {"cells": 500}})
    args = ["fit", "-o", str(tmp_path / "new"), *(option.replace("CONFIG", str(config)) for option in options)]
    assert cli.main(args) == 2
    said = capsys.readouterr()
    assert "CAPTURE" in said.err + said.out
    assert "Traceback" not in said.err


def test_resuming_takes_flags_again_that_the_run_was_started_with(tmp_path):
    """They are off by default then: that they are given must not be what is wrong."""
    out = str(tmp_path / "out")
    assert cli.main(["fit", "tooth", "-o", out, *VIEWS, *FIT, "--no-move", "--exchange.no-flips"]) == 0
    assert cli.main(["fit", "tooth", "-o", out, "--resume", "--no-move"]) == 0


def test_help_tells_of_the_file_and_shows_its_values(still, capsys):
    assert cli.main(["fit", "--help"]) == 0
    shown = capsys.readouterr().out
    assert "--config FILE" in shown and "{None}" not in shown and "options-file" not in shown and "--no-move " in shown
    assert cli.main(["fit", "--config", str(still), "--help"]) == 0
    assert "--move, --no-move" in capsys.readouterr().out
