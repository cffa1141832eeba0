"""Checkpoints: everything that the rest of a reconstruction depends on, in one safetensors file.

The tensors are the mesh, the parameters, the optimiser's moments and the history; the file's header holds the rest as
JSON. One file, renamed into place, so that a run killed at any moment leaves the last checkpoint whole.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch

from difftetvr.capture.capture import Capture
from difftetvr.files import atomic_write
from difftetvr.fit.config import FitConfig
from difftetvr.fit.errors import FitError

_VERSION = 1


@dataclass
class History:
    """What happened so far.

    Attributes:
        loss: Loss of each iteration.
        psnr: PSNR in dB of each iteration's training views, before its step.
        evaluations: Pairs of iteration and mean PSNR in dB over a few held-out views.
        seconds: Time spent, over all sessions of the run.
    """

    loss: list[float] = field(default_factory=list)
    psnr: list[float] = field(default_factory=list)
    evaluations: list[tuple[int, float]] = field(default_factory=list)
    seconds: float = 0.0


@dataclass
class Checkpoint:
    """The state between two iterations.

    Attributes:
        iteration: Iterations done.
        config: Options of the run.
        capture: What :func:`describe_capture` says about the images it runs on.
        tensors: Mesh, parameters and optimiser state by name.
        history: Losses and timings up to here.
    """

    iteration: int
    config: FitConfig
    capture: dict[str, Any]
    tensors: dict[str, torch.Tensor]
    history: History

    def save(self, path: Path) -> None:
        """Writes the checkpoint, whole or not at all.

        Raises:
            FitError: The file cannot be written.
        """
        state = {
            "version": _VERSION,
            "iteration": self.iteration,
            "config": self.config.to_json(),
            "capture": self.capture,
            "evaluations": self.history.evaluations,
            "seconds": self.history.seconds,
        }
        tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in self.tensors.items()}
        tensors["history.loss"] = torch.tensor(self.history.loss, dtype=torch.float64)
        tensors["history.psnr"] = torch.tensor(self.history.psnr, dtype=torch.float64)
        content = safetensors.torch.save(tensors, metadata={"state": json.dumps(state)})
        with atomic_write(path, FitError) as temporary:
            temporary.write_bytes(content)

    @staticmethod
    def load(path: Path) -> Checkpoint:
        """Reads a checkpoint.

        Raises:
            FitError: The file is missing, damaged or of another version.
        """
        try:
            with safetensors.safe_open(path, framework="pt") as file:
                state = json.loads((file.metadata() or {})["state"])
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            if state["version"] != _VERSION:
                raise FitError(
                    f"The checkpoint {path} has version {state['version']}, this program reads version {_VERSION}; "
                    "start anew."
                )
            history = History(
                tensors.pop("history.loss").tolist(),
                tensors.pop("history.psnr").tolist(),
                [(int(i), float(p)) for i, p in state["evaluations"]],
                float(state["seconds"]),
            )
            config = FitConfig.from_json(state["config"])
            return Checkpoint(int(state["iteration"]), config, state["capture"], tensors, history)
        except (OSError, KeyError, ValueError, TypeError, safetensors.SafetensorError) as error:
            raise FitError(f"The checkpoint {path} cannot be read ({error}); start anew.") from error


def describe_capture(capture: Capture) -> dict[str, Any]:
    """What tells one set of images from another: numbers that are compared when a run is resumed."""
    count, height, width, _ = capture.images.shape
    return {
        "views": count,
        "width": width,
        "height": height,
        "test_views": capture.test_indices.tolist(),
        "density_unit": float(capture.density_unit),
        "mean_radiance": float(capture.images.mean(dtype=torch.float64)),
    }


def require_same_capture(saved: dict[str, Any], current: dict[str, Any]) -> None:
    """Checks that a run is resumed on the images that it was started on.

    Raises:
        FitError: A description differs; names the first one.
    """
    for name, value in current.items():
        before = saved.get(name)
        same = math.isclose(before, value, rel_tol=1e-5) if isinstance(before, float) else before == value
        if not same:
            raise FitError(
                f"The saved run used images with {name} = {before}, these have {value}; "
                "resume with the same images or start anew."
            )
