"""``difftetvr fit`` in two processes: what it writes, what it says, and what is left when one of them ends."""

import errno
import json
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import pytest
from commands.helpers import VIEWS

import difftetvr.cli as cli
from difftetvr.cli.fit import _said_once
from difftetvr.errors import FitError
from difftetvr.fitting.records.checkpoint import Checkpoint

KILLED = Path(__file__).with_name("killed.py")
FIT = ["--cells", "500", "--iterations", "8", "--exchange.rounds", "2", "--exchange.views", "3", "--device", "cpu"]


def said_by(done):
    """What this program, not its launcher, has said was wrong."""
    return [line for line in done.stderr.splitlines() if line.startswith("difftetvr: ")]


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """A run of one process with as many views in an iteration as two processes have."""
    folder = tmp_path_factory.mktemp("alone") / "out"
    assert cli.main(["fit", "tooth", "-o", str(folder), *VIEWS, *FIT, "--batch-views", "2"]) == 0
    assert len(json.loads((folder / "metrics.json").read_text())["refinements"]) == 2
    return folder


def assert_same_run(folder, other):
    assert {p.name for p in folder.iterdir()} == {p.name for p in other.iterdir()}
    assert (folder / "model.vtu").read_bytes() == (other / "model.vtu").read_bytes()
    for name in ("metrics.json", "config.json"):
        one, two = (json.loads((f / name).read_text()) for f in (folder, other))
        assert {**one, "seconds": 0} == {**two, "seconds": 0}


def test_two_processes_leave_what_one_leaves(alone, two_processes, tmp_path):
    folder = tmp_path / "out"
    done = two_processes("-m", "difftetvr", "fit", "tooth", "-o", folder, *VIEWS, *FIT)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("2 processes, 2 views an iteration\n") == done.stdout.count("Model:  ") == 1
    assert_same_run(folder, alone)


def test_when_a_process_is_killed_one_sentence_and_a_checkpoint_for_one_process_are_left(
    alone, two_processes, tmp_path, capsys
):
    folder = tmp_path / "out"
    args = ["fit", "tooth", "-o", folder, *VIEWS, *FIT, "--checkpoint-seconds", "0"]
    done = two_processes(KILLED, *args)
    assert done.returncode != 0
    (sentence,) = said_by(done)
    assert sentence.startswith("difftetvr: Another of the 2 processes of this run has ended")
    assert "--resume" in sentence and sentence.endswith(".")
    assert {p.name for p in folder.iterdir()} == {"config.json", "checkpoint.safetensors"}
    assert Checkpoint.load(folder / "checkpoint.safetensors").iteration == 3
    assert cli.main(["fit", "tooth", "-o", str(folder), "--resume", "--checkpoint-seconds", "30"]) == 0
    assert "processes" not in capsys.readouterr().out
    assert_same_run(folder, alone)


def test_what_befalls_all_is_said_once_and_leaves_no_run(two_processes, tmp_path):
    done = two_processes("-m", "difftetvr", "fit", tmp_path / "nothing.nrrd", "-o", tmp_path / "out")
    assert done.returncode != 0
    (sentence,) = said_by(done)
    assert "nothing.nrrd" in sentence
    # The launcher may stop the first process amid an import, which leaves a lock that the next run takes over.
    assert {path.name for path in tmp_path.rglob("*")} <= {"out", "checkpoint.safetensors.lock"}


def test_arguments_that_are_wrong_are_said_by_the_first_process(monkeypatch, capsys):
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "none")
    for rank, said in (("0", 1), ("1", 0)):
        monkeypatch.setenv("RANK", rank)
        assert cli.main(["fit", "tooth", "-o", "out", "--cells", "many"]) == 2
        assert capsys.readouterr().err.count("difftetvr: ") == said


@dataclass
class OneOfTwo:
    """One of two processes, the first or the second that has something to say."""

    is_heard: bool
    count: int = 2

    def speaks_first(self):
        return self.is_heard


@contextmanager
def interrupted():
    """Where things are tidied up a signal comes, amid an error that is of no account."""
    try:
        yield
    finally:
        try:
            raise OSError(errno.ENOTEMPTY, "Directory not empty")
        except OSError:
            raise KeyboardInterrupt from None


@pytest.mark.parametrize("error", [FitError("This is wrong; mend it."), MemoryError()])
@pytest.mark.parametrize("tidying", [nullcontext, interrupted])
@pytest.mark.parametrize("is_heard", [True, False])
def test_the_first_process_that_meets_with_an_error_says_it(monkeypatch, error, tidying, is_heard):
    monkeypatch.setattr("signal.signal", lambda number, handler: None)
    with pytest.raises(BaseException) as caught, _said_once(OneOfTwo(is_heard)), tidying():
        raise error
    if is_heard:
        assert caught.value is error
    else:
        assert isinstance(caught.value, SystemExit) and caught.value.code == 2


@pytest.mark.parametrize("error", [KeyboardInterrupt(), TypeError("a mistake of the program")])
@pytest.mark.parametrize("is_heard", [True, False])
def test_what_is_no_error_of_users_is_left_as_it_is(monkeypatch, error, is_heard):
    monkeypatch.setattr("signal.signal", lambda number, handler: None)
    with pytest.raises(type(error)), _said_once(OneOfTwo(is_heard)):
        raise error
