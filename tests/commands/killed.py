"""The command line in one of two processes, the second of which is killed before its fourth iteration."""

import os
import signal
import sys

import difftetvr.cli as cli
from difftetvr.fitting.trainer import Trainer

step = Trainer.step


def step_or_be_killed(trainer):
    if trainer.processes.rank == 1 and trainer.iteration == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    step(trainer)


if __name__ == "__main__":
    Trainer.step = step_or_be_killed
    sys.exit(cli.main())
