"""What a search of views has found so far, in a file, so that one that was interrupted goes on."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from difftetvr.errors import FitError
from difftetvr.fitting.records.checkpoint import checksum, require_no_folder
from difftetvr.fitting.records.folder import write_json
from difftetvr.mesh.field import Field
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.rendering import Camera, ScalarField

_VERSION = 1


@dataclass(frozen=True)
class Viewpoint:
    """A camera and the entropy of what it sees.

    Attributes:
        camera: The camera.
        entropy: What is measured of its image; greater is better.
    """

    camera: Camera
    entropy: float

    def summary(self) -> dict[str, Any]:
        """Both as JSON holds them, to the last bit."""
        return {"entropy": self.entropy, "world_to_camera": self.camera.world_to_camera.double().cpu().tolist()}


@dataclass
class SearchRecord:
    """A search between two climbs.

    Attributes:
        problem: What tells it from others, see :func:`problem_of`.
        renderings: Images that were rendered.
        most_seen: Greatest opacity in any of them.
        scouts: Views that were rendered first, all of them.
        climbs: Views of each climb that has ended, from its start to its end.
    """

    problem: str
    renderings: int
    most_seen: float
    scouts: list[Viewpoint]
    climbs: list[list[Viewpoint]]

    def save(self, path: Path) -> None:
        """Writes it, whole or not at all.

        Raises:
            FitError: The file cannot be written.
        """
        state = {
            "problem": self.problem,
            "renderings": self.renderings,
            "most_seen": self.most_seen,
            "scouts": [view.summary() for view in self.scouts],
            "climbs": [[view.summary() for view in climb] for climb in self.climbs],
        }
        write_json(path, {"version": _VERSION, "sha256": checksum(json.dumps(state), {}), **state})

    @staticmethod
    def load(path: Path, like: Camera) -> SearchRecord:
        """Reads it.

        Args:
            path: Its file.
            like: A camera whose intrinsics all views have.

        Raises:
            FitError: The file is missing, damaged or of another version.
        """
        require_no_folder(path)
        try:
            state = json.loads(path.read_text())
            if state.pop("version") != _VERSION:
                raise FitError(f"The search in {path} is of another version of this program; start anew.")
            # So that whatever is changed is noticed, a number that would be another view's among it.
            if state.pop("sha256") != checksum(json.dumps(state), {}):
                raise ValueError
            scouts = [_view(view, like) for view in state.pop("scouts")]
            climbs = [[_view(view, like) for view in climb] for climb in state.pop("climbs")]
            return SearchRecord(scouts=scouts, climbs=climbs, **state)
        except FitError:
            raise
        except (OSError, ValueError, TypeError, KeyError, ArithmeticError, AttributeError, RecursionError) as error:
            reason = error.strerror if isinstance(error, OSError) else "it is no record of a search, or damaged"
            raise FitError(f"The search in {path} cannot be read ({reason}); start anew.") from error

    def require(self, problem: str, path: Path) -> None:
        """Checks that a search goes on with what it began with.

        Raises:
            FitError: It was something else.
        """
        if self.problem != problem:
            raise FitError(
                f"The search in {path} is of another mesh or field, or has other options; go on with the same or start "
                "anew."
            )


def problem_of(mesh: TetMesh, field: Field | ScalarField, options: dict[str, Any], colors: torch.Tensor | None) -> str:
    """What tells a search from others: a SHA-256 of all that decides what is found."""
    tensors = {"vertices": mesh.vertices, "tets": mesh.tets, **field.arrays()}
    numbers: list[Any] = [_as_floats(options), field.location, list(mesh.origin)]
    if isinstance(field, ScalarField):
        function = field.transfer_function
        tensors |= {"knots": function.scalar, "opacity": function.opacity, "colors": function.color}
        numbers += [field.attenuation, field.value_range]
    if colors is not None:
        tensors["references"] = colors
    parts = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    return checksum(json.dumps(numbers), parts)


def _as_floats(options: dict[str, Any]) -> dict[str, Any]:
    """Options of which equal ones look alike."""
    return {
        name: list(map(float, value)) if isinstance(value, tuple) else float(value) if type(value) is int else value
        for name, value in options.items()
    }


def _view(summary: dict[str, Any], like: Camera) -> Viewpoint:
    pose = torch.tensor(summary["world_to_camera"], dtype=torch.float64)
    return Viewpoint(like.with_pose(pose), float(summary["entropy"]))
