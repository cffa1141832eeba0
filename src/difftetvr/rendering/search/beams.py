"""Rays, and rays that run close together taken as one: what boxes may they cross? (Dr.Jit)"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.rendering.traversal.rays import Lanes

Triple = tuple[Any, Any, Any]


@dataclass
class Spread:
    """By how much the rays of a beam differ.

    Attributes:
        origin, direction: Half of the sides of the boxes that hold their origins and their directions.
    """

    origin: Triple
    direction: Triple


@dataclass
class Beam:
    """Rays, or boxes of rays that run close together.

    Attributes:
        origin, direction: Where each starts and goes, or the middles of these.
        near, far: Distances between which it is looked at, or any of it.
        valid: Which of them there are.
        spread: By how much the rays of each differ; None where each is one ray.
    """

    origin: Triple
    direction: Triple
    near: Any
    far: Any
    valid: Any
    spread: Spread | None = None

    @staticmethod
    def of(rays: Lanes, near: Any, far: Any) -> Beam:
        """Take rays that have origins."""
        assert rays.frame.origin is not None
        return Beam(rays.frame.origin, rays.frame.direction, near, far, rays.valid)

    @property
    def farthest(self) -> Triple:
        """Greatest coordinates of their origins."""
        x, y, z = (dr.abs(middle) for middle in self.origin)
        if self.spread is None:
            return x, y, z
        return x + self.spread.origin[0], y + self.spread.origin[1], z + self.spread.origin[2]

    def crosses(self, margin: Any) -> Callable[[list[Any], list[Any]], Any]:
        """A test of the middle and half of the sides of a box: whether a ray may cross it where it is looked at.

        Args:
            margin: By how much rounding may move boxes.
        """
        if self.spread is None:
            return self._crosses_line(margin)
        return self._crosses_spread(self.spread, margin)

    def _crosses_line(self, margin: Any) -> Callable[[list[Any], list[Any]], Any]:
        d, e = self.direction, [dr.abs(component) for component in self.direction]

        def test(center: list[Any], half: list[Any]) -> Any:
            c = [x - o for x, o in zip(center, self.origin, strict=True)]
            reach = dr.fma(half[0], e[0], dr.fma(half[1], e[1], dr.fma(half[2], e[2], margin)))
            is_met = self._is_ahead(c, reach)
            for i, j in _SIDES:
                is_met &= dr.abs(c[i] * d[j] - c[j] * d[i]) <= dr.fma(half[i], e[j], dr.fma(half[j], e[i], margin))
            return is_met

        return test

    def _crosses_spread(self, spread: Spread, margin: Any) -> Callable[[list[Any], list[Any]], Any]:
        """Origins that differ widen all boxes alike, directions those that are far away the more."""
        d, turns = self.direction, spread.direction
        e = [dr.abs(component) + turn for component, turn in zip(d, turns, strict=True)]

        def test(center: list[Any], half: list[Any]) -> Any:
            c = [x - o for x, o in zip(center, self.origin, strict=True)]
            away, half = [dr.abs(x) for x in c], [h + way for h, way in zip(half, spread.origin, strict=True)]
            reach = margin
            for h, far, component, turn in zip(half, away, e, turns, strict=True):
                reach = dr.fma(h, component, dr.fma(far, turn, reach))
            is_met = self._is_ahead(c, reach)
            for i, j in _SIDES:
                within = dr.fma(half[i], e[j], dr.fma(half[j], e[i], margin))
                within = dr.fma(away[i], turns[j], dr.fma(away[j], turns[i], within))
                is_met &= dr.abs(c[i] * d[j] - c[j] * d[i]) <= within
            return is_met

        return test

    def _is_ahead(self, center: list[Any], reach: Any) -> Any:
        """Whether what reaches so far around a place lies between the ends of a ray."""
        d = self.direction
        ahead = dr.fma(center[0], d[0], dr.fma(center[1], d[1], center[2] * d[2]))
        return (ahead + reach >= self.near) & (ahead - reach <= self.far)


_SIDES = ((1, 2), (2, 0), (0, 1))
"""The axes at right angles to a line and to a side of a box are these coordinates of the line, turned."""
