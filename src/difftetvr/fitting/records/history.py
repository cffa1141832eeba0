"""What happened in a run so far: losses, refinements, moves of vertices."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

from difftetvr.fitting.options import options_from_json
from difftetvr.mesh.tetmesh import TetMesh

_TRAIN_WINDOW = 64


@dataclass(frozen=True)
class RefinementRecord:
    """One refinement of the mesh.

    Attributes:
        iteration: Iterations done before it.
        cells_before: Cells before it.
        cells: Cells after it.
        vertices: Vertices after it.
        removed: Vertices taken away.
        added: Vertices made.
        flipped: Flips made.
        predicted: Predicted decrease of the mean squared error of some training views; None where a strategy predicts
            nothing.
        error_before: Mean squared error of these views before it.
        error_after: The same right after it, before any iteration.
    """

    iteration: int
    cells_before: int
    cells: int
    vertices: int
    removed: int
    added: int
    flipped: int
    predicted: float | None
    error_before: float
    error_after: float

    @property
    def achieved(self) -> float:
        """Decrease of the mean squared error."""
        return self.error_before - self.error_after


@dataclass(frozen=True)
class MoveTotals:
    """Moves of vertices, summed over all steps (see `StepReport`)."""

    steps: int = 0
    moved: int = 0
    capped: int = 0
    halved: int = 0
    refused: int = 0


@dataclass
class History:
    """What happened so far.

    Attributes:
        loss: Loss of each iteration.
        psnr: PSNR in dB of each iteration's training views, before its step.
        evaluations: Pairs of iteration and mean PSNR in dB over a few held-out views.
        refinements: Every refinement.
        moves: What became of the moves of vertices.
        budgets: Pairs of iteration and number of cells that the mesh may have from then on, where somebody has changed
            that while it ran.
        seconds: Time spent, over all sessions of the run, but for what watching it took.
    """

    loss: list[float] = field(default_factory=list)
    psnr: list[float] = field(default_factory=list)
    evaluations: list[tuple[int, float]] = field(default_factory=list)
    refinements: list[RefinementRecord] = field(default_factory=list)
    moves: MoveTotals = field(default_factory=MoveTotals)
    budgets: list[tuple[int, int]] = field(default_factory=list)
    seconds: float = 0.0

    def metrics(self, mesh: TetMesh) -> dict[str, Any]:
        """The numbers of a finished run with its mesh, as JSON values; see `FitResult.metrics`."""
        last = self.psnr[-_TRAIN_WINDOW:]
        return {
            "train_psnr": sum(last) / len(last) if last else None,
            "cells": mesh.num_cells,
            "vertices": mesh.num_vertices,
            "iterations": len(self.loss),
            "moves": dataclasses.asdict(self.moves),
            "refinements": [{**dataclasses.asdict(r), "achieved": r.achieved} for r in self.refinements],
            **({"budgets": self.budgets} if self.budgets else {}),
            "seconds": self.seconds,
        }

    def events(self) -> dict[str, Any]:
        """All but the series of every iteration, as JSON values."""
        return {
            "evaluations": self.evaluations,
            "refinements": [dataclasses.asdict(record) for record in self.refinements],
            "moves": dataclasses.asdict(self.moves),
            "budgets": self.budgets,
            "seconds": self.seconds,
        }

    @staticmethod
    def from_events(loss: list[float], psnr: list[float], events: dict[str, Any]) -> History:
        """The inverse of :meth:`events`; whatever is wrong with them raises one of Python's own errors or FitError."""
        return History(
            loss,
            psnr,
            [(int(i), float(p)) for i, p in events["evaluations"]],
            [options_from_json(RefinementRecord, record) for record in events["refinements"]],
            options_from_json(MoveTotals, events["moves"]),
            # Absent from checkpoints of before it could be changed.
            [(int(i), int(cells)) for i, cells in events.get("budgets", [])],
            float(events["seconds"]),
        )
