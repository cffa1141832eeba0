"""Errors of reconstruction."""

from __future__ import annotations

from difftetvr.errors import DiffTetError


class FitError(DiffTetError):
    """The options, the checkpoint or the output folder of a reconstruction is invalid."""
