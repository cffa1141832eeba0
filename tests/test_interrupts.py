"""Signals that ask a process to stop."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import difftetvr
from difftetvr.interrupts import InterruptFlag, OrderlyExit

SIGNALS = [number for number in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, number)]


@pytest.fixture(params=SIGNALS)
def asked(request):
    """A signal that is neither ignored nor deadly here; its handler is put back afterwards."""
    number = getattr(signal, request.param)
    before = signal.getsignal(number)
    signal.signal(number, signal.default_int_handler)
    yield number
    signal.signal(number, before)


def test_the_first_signal_raises_the_flag_and_the_second_has_its_usual_effect(asked):
    with InterruptFlag() as flag:
        assert not flag.raised
        signal.raise_signal(asked)
        assert flag.raised
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(asked)
    assert signal.getsignal(asked) is signal.default_int_handler


def test_where_a_launcher_repeats_signals_the_second_has_no_effect(asked):
    with InterruptFlag(patient=True) as flag:
        signal.raise_signal(asked)
        signal.raise_signal(asked)
        assert flag.raised
    with OrderlyExit(patient=True) as leave:
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(asked)
        signal.raise_signal(asked)
        assert leave.raised
    assert signal.getsignal(asked) is signal.default_int_handler


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="only POSIX has terminals that hang up")
def test_hang_ups_that_nohup_has_ignored_stay_so():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with InterruptFlag() as flag, OrderlyExit() as leave:
            signal.raise_signal(signal.SIGHUP)
        assert not flag.raised and not leave.raised
    finally:
        signal.signal(signal.SIGHUP, before)


def test_signals_become_interrupts_that_undo_what_is_half_done(asked):
    with OrderlyExit() as leave, pytest.raises(KeyboardInterrupt):
        signal.raise_signal(asked)
    assert leave.raised
    assert signal.getsignal(asked) is signal.default_int_handler


@pytest.mark.skipif(sys.platform == "win32", reason="there a process cannot send itself an interrupt alone")
@pytest.mark.parametrize("swallows", [True, False])
def test_amid_an_import_the_process_leaves_at_once(tmp_path, swallows):
    """Where Python would lose the interrupt, or show where it came from."""
    body = "import os, signal\n"
    body += "try:\n    os.kill(os.getpid(), signal.SIGINT)\nexcept KeyboardInterrupt:\n    " + (
        "pass\n" if swallows else "raise SystemError\n"
    )
    (tmp_path / "slow.py").write_text(body)
    code = """
import signal
from difftetvr.interrupts import OrderlyExit
signal.signal(signal.SIGINT, signal.default_int_handler)
print("before")
with OrderlyExit():
    import slow
print("after")
"""
    path = os.pathsep.join((str(tmp_path), str(Path(difftetvr.__file__).parents[1])))
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "before\n", "")
