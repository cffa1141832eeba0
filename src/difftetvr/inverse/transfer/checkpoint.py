"""The state of a fit of a transfer function in one safetensors file."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch

from difftetvr.errors import FitError
from difftetvr.files import atomic_write

_VERSION = 1
_FREE = ("checkpoint_seconds",)  # options that a resumed run may have otherwise


@dataclass(frozen=True)
class TransferCheckpoint:
    """The state between two iterations.

    Attributes:
        iteration: Iterations done.
        options: Of the run, by name.
        problem: What tells its mesh, scalars and images from others.
        losses: Of all iterations.
        seconds: How long they took.
        tensors: The knots' values and moments, and those that it began with.
    """

    iteration: int
    options: dict[str, Any]
    problem: str
    losses: list[float]
    seconds: float
    tensors: dict[str, torch.Tensor]

    def save(self, path: Path) -> None:
        """Writes the checkpoint, whole or not at all.

        Raises:
            FitError: The file cannot be written.
        """
        names = ("iteration", "options", "problem", "losses", "seconds")
        state = {"version": _VERSION} | {name: getattr(self, name) for name in names}
        tensors = {name: tensor.detach().cpu().clone() for name, tensor in self.tensors.items()}
        content = safetensors.torch.save(tensors, metadata={"transfer": json.dumps(state)})
        with atomic_write(path, FitError) as temporary:
            temporary.write_bytes(content)

    @staticmethod
    def load(path: Path, options: dict[str, Any], problem: str, like: dict[str, torch.Tensor]) -> TransferCheckpoint:
        """Reads the checkpoint of a run.

        Args:
            path: The file.
            options: That the run is to have now.
            problem: What it is to be of.
            like: Tensors of the right names and shapes.

        Raises:
            FitError: The file is missing, damaged, or of a run with other options, scalars or images.
        """
        try:
            with safetensors.safe_open(path, framework="pt") as file:
                state = json.loads((file.metadata() or {})["transfer"])
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            found = TransferCheckpoint(
                int(state["iteration"]),
                dict(state["options"]),
                str(state["problem"]),
                [float(loss) for loss in state["losses"]],
                float(state["seconds"]),
                tensors,
            )
            version = state["version"]
        except (OSError, KeyError, ValueError, TypeError, RecursionError, safetensors.SafetensorError):
            raise FitError(f"The checkpoint {path} is missing, damaged or of another kind; start anew.") from None
        if version != _VERSION:
            raise FitError(f"The checkpoint {path} has version {version}, not {_VERSION}; start anew.")
        found._require_same(path, options, problem, like)
        return found

    def _require_same(self, path: Path, options: dict[str, Any], problem: str, like: dict[str, torch.Tensor]) -> None:
        asked = json.loads(json.dumps(options))
        for name, value in asked.items():
            if name not in _FREE and self.options.get(name) != value:
                raise FitError(
                    f"The run of {path} has {name} {self.options.get(name)}, not {value}; resume with the same options "
                    "or start anew."
                )
        if self.problem != problem:
            raise FitError(f"The run of {path} is of other scalars or images; resume with the same or start anew.")
        shapes = {name: tensor.shape for name, tensor in self.tensors.items()}
        if shapes != {name: tensor.shape for name, tensor in like.items()} or len(self.losses) != self.iteration:
            raise FitError(f"The checkpoint {path} is damaged; start anew.")


def digest_of(tensors: list[torch.Tensor], texts: list[str]) -> str:
    """SHA-256 of tensors' bytes and of texts."""
    digest = hashlib.sha256("\n".join(texts).encode())
    for tensor in tensors:
        digest.update(tensor.detach().cpu().contiguous().reshape(-1).numpy().tobytes())
    return digest.hexdigest()
