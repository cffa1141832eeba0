"""What each of several processes does for the tests of fitting together: started by torchrun, given a folder."""

import dataclasses
import signal
import sys
from pathlib import Path

import torch

from difftetvr.capture import VolumeCapture
from difftetvr.errors import FitError
from difftetvr.fitting import Exchange, FitConfig, Processes, Star, fit
from difftetvr.fitting.records.checkpoint import Checkpoint
from difftetvr.fitting.trainer import Trainer

CAPTURE = VolumeCapture(views=10, width=24, height=24, steps_per_unit=300.0)
EXCHANGE = FitConfig(cells=500, iterations=14, evaluate_every=5, device="cpu", exchange=Exchange(rounds=5, views=3))
CONFIGS = {
    "exchange": EXCHANGE,
    "bands": dataclasses.replace(EXCHANGE, iterations=6, harmonics=1, exchange=Exchange(rounds=2, views=3)),
    "poses": dataclasses.replace(
        EXCHANGE, iterations=6, refine_poses=True, refine_intrinsics=True, exchange=Exchange(rounds=2, views=3)
    ),
    "star": dataclasses.replace(EXCHANGE, iterations=10, refine="star", star=Star(views=3, initial=0.2)),
}
"""Each refines its mesh; the second has a bundle of rays for each view, the others one for all. One moves cameras."""


def state_of(trainer):
    """All that two processes must agree on, and that is compared with one's."""
    history = trainer.history
    return {
        **trainer.checkpoint().tensors,
        "loss": torch.tensor(history.loss, dtype=torch.float64),
        "evaluations": torch.tensor(history.evaluations, dtype=torch.float64),
        "errors": torch.tensor([r.error_after for r in history.refinements], dtype=torch.float64),
    }


def advanced(trainer, steps=None):
    for _ in range(trainer.config.steps - trainer.iteration if steps is None else steps):
        trainer.step()
    trainer.glance()
    return trainer


def disagreement(capture, processes):
    """What is said when one vertex of one process lies a little elsewhere."""
    trainer = Trainer(capture, CONFIGS["exchange"], processes=processes)
    trainer.require_agreement()
    trainer.parameters.density.data[3] += 1e-7 * processes.rank
    try:
        trainer.require_agreement()
    except FitError as error:
        return str(error)
    return None


def idle(capture, processes):
    """A run of one view an iteration, in which all processes but one have nothing to render."""
    return state_of(advanced(Trainer(capture, dataclasses.replace(EXCHANGE, batch_views=1), processes=processes), 5))


def interrupted(capture, file, processes):
    """Iterations that are saved when the last process alone is interrupted after the second, twice as launchers do."""

    def interrupt(progress):
        if progress.iteration == 2 and processes.rank == processes.count - 1:
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGTERM)

    try:
        fit(capture, EXCHANGE, checkpoint=file, on_progress=interrupt, processes=processes)
    except KeyboardInterrupt:
        return Checkpoint.load(file).iteration
    return None


def main(folder):
    with Processes.joined() as processes:
        capture = CAPTURE.build()
        found = {
            name: state_of(advanced(Trainer(capture, config, processes=processes))) for name, config in CONFIGS.items()
        }
        four = dataclasses.replace(EXCHANGE, batch_views=4)
        found["four"] = state_of(advanced(Trainer(capture, four, processes=processes), 3))
        resumed = fit(capture, EXCHANGE, checkpoint=folder / "begun.safetensors", resume=True, processes=processes)
        found["resumed"] = {"color": resumed.field.color, "vertices": resumed.mesh.vertices, "tets": resumed.mesh.tets}
        found["metrics"] = {**resumed.metrics, "seconds": 0}
        found["disagreement"] = disagreement(capture, processes)
        found["idle"] = idle(capture, processes)
        found["interrupted"] = interrupted(capture, folder / "interrupted.safetensors", processes)
        torch.save(found, folder / f"{processes.rank}.pt")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
