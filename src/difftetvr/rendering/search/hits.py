"""Rays that enter cells (Dr.Jit)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass
class Hit:
    """Rays that may enter cells.

    Attributes:
        pixel: The ray's pixel, or number.
        lane: The lane that has that ray where each lane has one.
        half_face: Through which it would enter.
        depth: At which distance along it.
        is_hit: Whether it does so, where it is looked at.
    """

    pixel: Any
    lane: Any
    half_face: Any
    depth: Any
    is_hit: Any


Visit = Callable[[Hit], None]
"""Takes a hit."""

Settle = Callable[[], Any]
"""Is called after each kernel's worth of hits."""
