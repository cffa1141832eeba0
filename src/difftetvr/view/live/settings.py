"""How a scene is seen: what is shown of it, what is cut away, and what scalars look like."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from difftetvr.optics.transfer_function import TransferFunction

Mode = Literal["color", "depth", "opacity", "cell quality", "depth complexity", "error"]
"""What the pixels of a picture say, see `difftetvr.view.live.quantities.QUANTITIES`."""

MODES: tuple[Mode, ...] = get_args(Mode)
Color3 = tuple[float, float, float]
HalfSpace = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class ScalarLook:
    """What scalars look like.

    Attributes:
        transfer_function: Colour and opacity of scalars in units of the range.
        value_range: Scalars that stand for 0 and 1 of it.
        density: Density of opacity 1, where the longest side of what is seen is 1; >= 0.
    """

    transfer_function: TransferFunction
    value_range: tuple[float, float]
    density: float


@dataclass(frozen=True, eq=False)
class Settings:
    """How a scene is seen; the same in all windows.

    Attributes:
        mode: What is shown.
        background: R G B behind what is seen, as the colours of pictures are.
        clip: a, b, c, d: only what lies in the half-space a x + b y + c z + d >= 0 of the world is seen; None: all.
        look: What scalars look like; None where there are none.
    """

    mode: Mode = "color"
    background: Color3 = (0.0, 0.0, 0.0)
    clip: HalfSpace | None = None
    look: ScalarLook | None = None
