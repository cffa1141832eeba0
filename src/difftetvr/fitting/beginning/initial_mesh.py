"""The mesh of a file as the beginning of a reconstruction."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from difftetvr.capture.capture import Capture
from difftetvr.errors import FitError, MeshError
from difftetvr.fitting.config import FitConfig
from difftetvr.fitting.refinement import Strategy
from difftetvr.mesh.field import Field
from difftetvr.mesh.io import load_data, load_with_optional_field
from difftetvr.mesh.tetmesh import TetMesh


@dataclass(frozen=True)
class Start:
    """What a reconstruction begins with.

    Attributes:
        mesh: The mesh.
        field: Its colours and densities; None: those of the options.
        repair: What mending the mesh changed, in words; None where it was not mended.
    """

    mesh: TetMesh
    field: Field | None = None
    repair: str | None = None


def load_start(capture: Capture, config: FitConfig, strategy: Strategy | None) -> Start:
    """Reads the initial mesh that the options name, and checks that it suits them and the images.

    Args:
        capture: Images and cameras.
        config: Options with an initial mesh.
        strategy: How the mesh is refined.

    Raises:
        FitError: It does not overlap the capture's bounds, has more cells than it may grow to, or its field has
            another location than the options or colours out of range.
        MeshError: It cannot be read, or is not valid; says so if repairing would mend it.
    """
    path = Path(config.initial_mesh or "")
    start = _load_repaired(path) if config.repair else _load_valid(path)
    _require_overlap(path, start.mesh, capture)
    if strategy is not None and strategy.initial_cells(config.budget) < config.budget < start.mesh.num_cells:
        raise FitError(
            f"{path} has {start.mesh.num_cells:,} cells, more than the {config.budget:,} that it may grow to; give "
            "more with --cells, or do not let it grow (--refine exchange or none)."
        )
    _require_usable(path, start, config)
    return start


def _load_valid(path: Path) -> Start:
    try:
        return Start(*load_with_optional_field(path))
    except MeshError as error:
        try:
            _load_repaired(path)
        except MeshError:
            raise error from None
        reason = str(error).split("; load with")[0].rstrip(".")
        raise MeshError(f"{reason}; have it mended with --repair (repair=True).") from error


def _load_repaired(path: Path) -> Start:
    data = load_data(path, flat="repair")
    return Start(data.mesh, data.field, data.repair)


def _require_overlap(path: Path, mesh: TetMesh, capture: Capture) -> None:
    own, seen = mesh.bounds().double(), capture.bounds.double()
    if bool((torch.minimum(own[1], seen[1]) > torch.maximum(own[0], seen[0])).all()):
        return
    raise FitError(
        f"{path} lies in {_box(own)}, but what the images show in {_box(seen)}; move or scale the mesh so that they "
        "overlap."
    )


def _require_usable(path: Path, start: Start, config: FitConfig) -> None:
    if not start.mesh.is_conforming:
        raise FitError(f"The cells of {path} do not meet face to face, as moving vertices and refining need it.")
    if start.field is None:
        return
    location = start.field.location_on(start.mesh)
    if location != config.location:
        advice = "--location cell --refine none" if location == "cell" else "--location vertex"
        raise FitError(f"The colours of {path} belong to its {location}s; use {advice}, or a mesh without colours.")
    least, most = start.field.color.aminmax()
    if least < 0 or most > 1:
        raise FitError(
            f"The colours of {path} go from {float(least):g} to {float(most):g}, but those of a reconstruction from 0 "
            "to 1; scale them."
        )


def _box(bounds: torch.Tensor) -> str:
    lower, upper = (", ".join(f"{x:.4g}" for x in corner) for corner in bounds.tolist())
    return f"({lower}) to ({upper})"
