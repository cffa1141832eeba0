"""What the commands print: names of files as they are, in any encoding."""

import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from commands.helpers import FIT, LOOP, VIEWS, fails, raising

import difftetvr.cli as cli


@pytest.mark.parametrize("name", ["d[b].vtu", "[red]x.vtu", "x[bold].vtu", ":apple:.vtu", "d[/b].vtu"])
def test_names_of_files_are_shown_as_they_are(run, tmp_path, capsys, name):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes((run / "model.vtu").read_bytes())
    assert cli.main(["info", str(path)]) == 0
    assert name in capsys.readouterr().out
    assert cli.main(["render", str(path), "-o", f"{path}.png", "--width", "8", "--height", "8"]) == 0
    assert f"Wrote {path}.png (8 x 8)" in capsys.readouterr().out
    assert cli.main(["export", str(path), f"{path}.npz"]) == 0
    assert f"Wrote {path}.npz" in capsys.readouterr().out


def test_names_with_line_breaks_stay_one_line(tmp_path, capsys):
    assert "no\\nthing" in fails(capsys, "info", tmp_path / "no\nthing.vtu")


def difftetvr(*args, **environment):
    """Runs the command line as a process of its own."""
    source = str(Path(cli.__file__).parents[2])
    return subprocess.run(
        [sys.executable, "-m", "difftetvr", *(str(a) for a in args)],
        capture_output=True,
        env={**os.environ, "PYTHONPATH": source, **environment},
    )


def test_encodings_without_blocks_and_accents(run, tmp_path, capsys):
    path = tmp_path / "zähne.vtu"
    path.write_bytes((run / "model.vtu").read_bytes())
    done = difftetvr("info", path, PYTHONIOENCODING="ascii", PYTHONUTF8="0")
    assert (done.returncode, done.stderr) == (0, b"")
    shown = done.stdout.decode("ascii")
    assert "#####" in shown
    assert "z\\xe4hne.vtu" in shown
    assert cli.main(["info", str(path)]) == 0
    assert "█████" in capsys.readouterr().out


def test_the_package_runs_as_a_module(tmp_path):
    source = str(Path(cli.__file__).parents[2])
    command = [sys.executable, "-m", "difftetvr", "info", str(tmp_path / "nothing.vtu")]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": source})
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"difftetvr: There is no mesh file {tmp_path}/nothing.vtu; check the path.\n"


def test_interrupted_runs_tell_a_command_that_shells_understand(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(LOOP, "optimise", raising(KeyboardInterrupt()))
    folder = tmp_path / "my [b]run's"
    assert cli.main(["fit", "tooth", "-o", str(folder), *VIEWS, *FIT]) == 130
    line = capsys.readouterr().out.strip()
    command = line.partition("continue with: ")[2]
    assert shlex.split(command) == ["difftetvr", "fit", "-o", str(folder), "--resume"]
