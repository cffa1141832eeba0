"""Checkpoints: everything that the rest of a reconstruction depends on, in one safetensors file.

The tensors are the mesh, the parameters, the optimiser's moments, means over iterations, and the history; the file's
header holds the rest as JSON, and a checksum of everything, because a run that goes on from a flipped bit would look
like any other. One file, renamed into place, so that a run killed at any moment leaves the last checkpoint whole.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch

from difftetvr.capture.capture import Capture
from difftetvr.errors import FitError, MeshError
from difftetvr.files import atomic_write, locked, remove_leftovers, stem_of
from difftetvr.fitting.config import FitConfig
from difftetvr.fitting.options import RunOptions
from difftetvr.fitting.records.history import History
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.rendering.cameras.lens import LensCamera

_VERSION = 6
_HISTORY = ("history.loss", "history.psnr")


@dataclass
class Checkpoint:
    """The state between two iterations.

    Attributes:
        iteration: Iterations done.
        config: Options of the run, such as a :class:`FitConfig`.
        capture: What :func:`describe_capture` says about the images it runs on.
        tensors: Mesh, parameters and optimiser state by name.
        budget: Cells that the mesh may have.
        strategy: Name of the refinement strategy's class.
        history: Losses and timings up to here.
        repair: What mending the initial mesh changed, in words; None where it was not mended.
        source: What to call it in messages; the file that it was read from.
    """

    iteration: int
    config: Any
    capture: dict[str, Any]
    tensors: dict[str, torch.Tensor]
    budget: int
    strategy: str
    history: History
    repair: str | None = None
    source: str = field(default="checkpoint", compare=False)

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
            "budget": self.budget,
            "strategy": self.strategy,
            "repair": self.repair,
            **self.history.events(),
        }
        tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in self.tensors.items()}
        for name, values in zip(_HISTORY, (self.history.loss, self.history.psnr), strict=True):
            tensors[name] = torch.tensor(values, dtype=torch.float64)
        text = json.dumps(state)
        metadata = {"state": text, "sha256": checksum(text, tensors)}
        try:
            content = safetensors.torch.save(tensors, metadata=metadata)
        except BaseException as panic:
            # So its compiled code says that it gets no memory; that is no Exception, so nobody would tidy up.
            if type(panic).__name__ == "PanicException":
                raise MemoryError(str(panic)) from panic
            raise
        with atomic_write(path, FitError) as temporary:
            temporary.write_bytes(content)

    @staticmethod
    def load(path: Path, options: type[RunOptions] = FitConfig) -> Checkpoint:
        """Reads a checkpoint.

        Args:
            path: Its file.
            options: Dataclass of the run's options.

        Raises:
            FitError: The file is missing, damaged or of another version.
        """
        require_no_folder(path)
        try:
            with safetensors.safe_open(path, framework="pt") as file:
                metadata = file.metadata() or {}
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            state = json.loads(metadata["state"])
            version = state["version"]
        except (OSError, KeyError, ValueError, TypeError, RecursionError, safetensors.SafetensorError) as error:
            raise _unreadable(path, _reason(error)) from error
        if version != _VERSION:
            raise FitError(
                f"The checkpoint {path} has version {version}, this program reads version {_VERSION}; start anew."
            )
        if metadata.get("sha256") != checksum(metadata["state"], tensors):
            raise _unreadable(path, "its content does not match its checksum")
        try:
            return _checkpoint(state, tensors, str(path), options)
        except (FitError, KeyError, ValueError, TypeError, AttributeError, OverflowError) as error:
            raise _unreadable(path, _reason(error)) from error

    def digest(self) -> str:
        """SHA-256 of what the next iterations depend on: options, mesh, parameters, moments, which images."""
        tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in self.tensors.items()}
        # Machines may read the same images to other last digits.
        images = {name: value for name, value in self.capture.items() if not isinstance(value, float)}
        return checksum(json.dumps([self.iteration, self.config.to_json(), images, self.budget]), tensors)

    def mesh(self) -> TetMesh:
        """The mesh of the run.

        Raises:
            FitError: There is none, or it is not valid.
        """
        try:
            return TetMesh(self.tensors["vertices"], self.tensors["tets"])
        except (KeyError, MeshError) as error:
            raise _unreadable(self.source, _reason(error)) from error

    def require_not_beyond(self, steps: int) -> None:
        """Checks that the run has not come further than it is to go.

        Args:
            steps: Iterations that it is to have.

        Raises:
            FitError: It has.
        """
        if self.iteration > steps:
            raise FitError(
                f"The saved run has done {self.iteration} iterations already, this one is to have {steps}; resume with "
                "at least as many, or start anew."
            )

    def require_strategy(self, current: str) -> None:
        """Checks that the run goes on with the kind of strategy that it began with.

        Args:
            current: Name of the strategy's class.

        Raises:
            FitError: It was another.
        """
        if current != self.strategy:
            raise FitError(
                f"The saved run refines its mesh by {self.strategy}, not {current}; resume with the same strategy or "
                "start anew."
            )

    def require_tensors_like(self, expected: dict[str, torch.Tensor]) -> None:
        """Checks that the tensors are those that the run needs.

        Args:
            expected: Tensors of the right names, shapes and types.

        Raises:
            FitError: One is missing, or of another shape or type; names the first one.
        """
        for name, tensor in expected.items():
            saved = self.tensors.get(name)
            if saved is None:
                raise _unreadable(self.source, f"it lacks '{name}'")
            if saved.shape != tensor.shape or saved.dtype != tensor.dtype:
                raise _unreadable(
                    self.source,
                    f"'{name}' is {saved.dtype} of shape {tuple(saved.shape)}, not {tensor.dtype} of shape "
                    f"{tuple(tensor.shape)}",
                )


@contextmanager
def alone_with(path: Path) -> Iterator[None]:
    """Context manager that one run at a time is in, of all that save the same checkpoint.

    What a run that was killed had written of it is removed.

    Raises:
        FitError: Another run is in, or nothing can be created there.
    """
    busy = f"Another run saves its checkpoint as {path}; wait for it, stop it, or choose another name."
    with locked(path, FitError, busy):
        remove_leftovers(path.parent, stem_of(path))
        yield


def require_no_folder(path: Path) -> None:
    """Checks that a checkpoint can have a name.

    Raises:
        FitError: It is that of a folder.
    """
    if path.is_dir():
        raise FitError(f"{path} is a folder where the checkpoint should be a file; rename or remove it.")


def _checkpoint(
    state: dict[str, Any], tensors: dict[str, torch.Tensor], source: str, options: type[RunOptions]
) -> Checkpoint:
    """A checkpoint from the parts of a file; whatever is wrong with them raises one of Python's own errors."""
    loss, psnr = (tensors.pop(name).tolist() for name in _HISTORY)
    history = History.from_events(loss, psnr, state)
    config = options.from_json(state["config"])
    iteration, capture = state["iteration"], state["capture"]
    if not isinstance(iteration, int) or not iteration == len(loss) == len(psnr) <= config.steps:
        raise ValueError(f"its history has {len(loss)} losses after {iteration} iterations")
    if not isinstance(capture, dict):
        raise TypeError("it does not describe its images")
    budget, strategy = int(state["budget"]), str(state["strategy"])
    # Absent from checkpoints of before there were initial meshes.
    repair = None if state.get("repair") is None else str(state["repair"])
    return Checkpoint(iteration, config, capture, tensors, budget, strategy, history, repair, source)


def checksum(state: str, tensors: dict[str, torch.Tensor]) -> str:
    """SHA-256 of a text and of every tensor's name, type, shape and bytes; they are contiguous and on the CPU."""
    digest = hashlib.sha256(state.encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"\n{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.reshape(-1).numpy().data)
    return digest.hexdigest()


def _reason(error: Exception) -> str:
    return f"it lacks {error}" if isinstance(error, KeyError) else str(error)


def _unreadable(source: str | Path, why: str) -> FitError:
    why = " ".join(why.split()).rstrip(".")
    return FitError(
        f"The checkpoint {source} cannot be read ({why}); start anew, on the command line with --overwrite."
    )


def describe_capture(capture: Capture) -> dict[str, Any]:
    """What tells one set of images from another: numbers that are compared when a run is resumed."""
    widths, heights = (sorted(set(sides)) for sides in zip(*capture.image_sizes, strict=True))
    lenses = sum(isinstance(camera, LensCamera) for camera in capture.cameras)
    return {
        "views": len(capture.cameras),
        "width": widths[0] if len(widths) == 1 else widths,
        "height": heights[0] if len(heights) == 1 else heights,
        "test_views": capture.test_indices.tolist(),
        "density_unit": float(capture.density_unit),
        "mean_radiance": float(capture.images.mean(dtype=torch.float64)),
        "lenses": lenses,
    }


def require_same_capture(saved: dict[str, Any], current: dict[str, Any]) -> None:
    """Checks that a run is resumed on the images that it was started on.

    Raises:
        FitError: A description differs; names the first one.
    """
    for name, value in current.items():
        before = saved.get(name, 0)  # "lenses" are absent from checkpoints of before there were any
        if isinstance(before, float) and isinstance(value, float):
            same = math.isclose(before, value, rel_tol=1e-5)
        else:
            same = before == value
        if not same:
            raise FitError(
                f"The saved run used images with {name} = {before}, these have {value}; "
                "resume with the same images or start anew."
            )
