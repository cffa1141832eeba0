"""The parent: makes inputs, hands them to a child for each core, and ends children that take too long or too much.

    PYTHONPATH=src:tests python -m fuzz [--inputs N] [--seconds S] [--seed K] [--only I ...] [--keep FOLDER]

Input i of seed K is the same wherever the same versions of the packages wrote the intact files; `--only I` makes it
again, `--keep` leaves the inputs that failed in a folder.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import os
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from fuzz.mutations import mutate
from fuzz.seeds import Seed, write_seeds

SECONDS = 20.0
MEMORY = 2 * 10**9  # more than what a child has when it begins
_LOOK = 0.1  # seconds between two looks at a child's memory
_START = 300.0  # seconds a child may take to import everything


class Child:
    """A process that judges, started again when it had to be ended."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._before = 0

    def judge(self, kind: str, path: Path) -> tuple[str, str]:
        """What became of a file, and why: "content", "sentence" or "FAILURE"."""
        if self._process is None:
            self._start()
        outcome, details, peak = self._ask(kind, path, SECONDS)
        if peak - self._before > MEMORY:
            return "FAILURE", f"It took {peak - self._before:,} bytes of memory."
        return outcome, details

    def close(self) -> None:
        """Ends it, with the readers that it runs in processes of their own."""
        if self._process is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.communicate()
            self._process = None

    def _start(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "fuzz.judge"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        # A file that is not there shows that all is imported.
        outcome, details, _ = self._ask("mesh", Path("none.vtu"), _START)
        if outcome != "sentence":
            raise RuntimeError(f"A child does not start: {details}")
        self._before = self._memory()

    def _ask(self, kind: str, path: Path, seconds: float) -> tuple[str, str, int]:
        process = self._process
        assert process is not None and process.stdin is not None and process.stdout is not None
        begin = time.monotonic()
        process.stdin.write(json.dumps([kind, str(path)]).encode() + b"\n")
        process.stdin.flush()
        while not select.select([process.stdout], [], [], _LOOK)[0]:
            reason = ""
            if time.monotonic() - begin > seconds:
                reason = f"It took more than {seconds:.0f} s."
            elif self._before and self._memory() - self._before > MEMORY:
                reason = f"It took more than {MEMORY:,} bytes of memory."
            if reason:
                self.close()
                return "FAILURE", reason, 0
        line = process.stdout.readline()
        if not line:
            code = process.wait()
            self.close()
            return "FAILURE", f"The process broke off with code {code}.", 0
        outcome, details, peak = json.loads(line)
        return outcome, details, peak

    def _memory(self) -> int:
        assert self._process is not None
        with contextlib.suppress(OSError, IndexError):
            pages = Path(f"/proc/{self._process.pid}/statm").read_text(encoding="ascii").split()[1]
            return int(pages) * os.sysconf("SC_PAGE_SIZE")
        return 0


class Fuzzer:
    """What the children share: the inputs still to do, and what became of those that are done."""

    def __init__(self, seeds: list[Seed], seed: int, numbers: Iterator[int], until: float, keep: Path | None) -> None:
        self.seeds, self.seed, self.keep = seeds, seed, keep
        self.outcomes: Counter[tuple[str, str]] = Counter()
        self._numbers, self._until = numbers, until
        self._lock = threading.Lock()
        shares = np.array([s.share for s in seeds])
        self._shares = shares / shares.sum()

    def make(self, number: int, folder: Path) -> tuple[Seed, str]:
        """Writes an input into an empty folder; which seed it comes of, and what was done to it."""
        rng = np.random.default_rng([self.seed, number])
        seed = self.seeds[int(rng.choice(len(self.seeds), p=self._shares))]
        shutil.copytree(seed.folder, folder, copy_function=os.link, dirs_exist_ok=True)
        victim = seed.files[int(rng.integers(len(seed.files)))]
        return seed, f"{mutate(rng, folder, victim)} of {victim}"

    def work(self, folder: Path) -> None:
        """What one thread does, with one child."""
        child = Child()
        try:
            while time.monotonic() < self._until:
                with self._lock:
                    number = next(self._numbers, None)
                if number is None:
                    break
                target = folder / "input"
                target.mkdir(parents=True)
                seed, what = self.make(number, target)
                outcome, details = child.judge(seed.kind, target / seed.name)
                with self._lock:
                    self._note(number, seed, what, outcome, details, target)
                shutil.rmtree(target)
        finally:
            child.close()

    def _note(self, number: int, seed: Seed, what: str, outcome: str, details: str, target: Path) -> None:
        self.outcomes[seed.label, outcome] += 1
        if outcome == "FAILURE":
            print(f"--seed {self.seed} --only {number}: {seed.kind} {seed.name}, {what}:\n{details}", flush=True)
            if self.keep is not None:
                shutil.copytree(target, self.keep / str(number), symlinks=True, ignore=_pipes, dirs_exist_ok=True)


def _pipes(folder: str, names: list[str]) -> list[str]:
    return [name for name in names if (Path(folder) / name).is_fifo()]


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="fuzz", description="Reads damaged files of all kinds.")
    parser.add_argument("--inputs", type=int, default=100_000, help="how many, at most")
    parser.add_argument("--seconds", type=float, default=3600.0, help="how long, at most")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, nargs="+", help="numbers of inputs to make again")
    parser.add_argument("--keep", type=Path, help="folder for the inputs that failed")
    return parser.parse_args()


def main() -> int:
    """Runs the fuzzer; 1 if anything failed."""
    options = _arguments()
    with tempfile.TemporaryDirectory() as name:
        seeds = write_seeds(Path(name) / "intact")
        _require_intact(seeds)
        numbers = itertools.islice(iter(options.only or itertools.count()), options.inputs)
        fuzzer = Fuzzer(seeds, options.seed, numbers, time.monotonic() + options.seconds, options.keep)
        workers = [
            threading.Thread(target=fuzzer.work, args=(Path(name) / f"child{index}",))
            for index in range(os.cpu_count() or 1)
        ]
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
    for (label, outcome), count in sorted(fuzzer.outcomes.items()):
        print(label, outcome, count)
    failures = sum(count for (_, outcome), count in fuzzer.outcomes.items() if outcome == "FAILURE")
    print(f"{fuzzer.outcomes.total():,} inputs, {failures:,} failures")
    return int(failures > 0)


def _require_intact(seeds: list[Seed]) -> None:
    """What is intact must be read, or its damages say nothing."""
    child, wrong = Child(), []
    try:
        for seed in seeds:
            outcome, details = child.judge(seed.kind, seed.folder / seed.name)
            if outcome != "content":
                wrong.append(f"{seed.kind} {seed.name}: {outcome} {details}")
    finally:
        child.close()
    assert not wrong, "\n".join(wrong)


if __name__ == "__main__":
    sys.exit(main())
