"""Colour maps by name: those of Matplotlib, and the scientific ones of cmcrameri where that is installed."""

from __future__ import annotations

import difflib
import importlib

import numpy as np
import torch
from matplotlib import colormaps

from difftetvr.errors import CaptureError

DEFAULT_COLORMAP = "coolwarm"
_CRAMERI = "cmcrameri"
_PREFIX = "cmc."  # under which it adds its maps to Matplotlib's


def colormap_colors(name: str, positions: torch.Tensor) -> torch.Tensor:
    """Colours of a map at positions on it.

    They are taken as the map has them, as for pictures, which are written without a gamma curve, too: what is opaque
    has exactly the colour of the map.

    Args:
        name: One of Matplotlib's, such as viridis or coolwarm_r; or one of cmcrameri's (extra ``colormaps``), such as
            batlow, with ``cmc.`` before it where both have it.
        positions: (K,) in [0, 1].

    Returns:
        (K, 3) float32 RGB in [0, 1].

    Raises:
        CaptureError: There is no such map.
    """
    colors = colormaps[_registered(name)](positions.detach().cpu().double().numpy())
    return torch.from_numpy(np.ascontiguousarray(colors[:, :3])).float()


def _registered(name: str) -> str:
    """The name under which Matplotlib knows a map."""
    if name in colormaps:
        return name
    try:
        importlib.import_module(_CRAMERI)
    except ImportError:
        missing = "; those of cmcrameri need a package: pip install 'difftetvr[colormaps]'"
    else:
        missing = ""
    for known in (name, _PREFIX + name):
        if known in colormaps:
            return known
    alike = difflib.get_close_matches(name, list(colormaps), 1)
    hint = f"is it '{alike[0]}'?" if alike else "give a name of Matplotlib's, such as viridis"
    raise CaptureError(f"There is no colour map '{name}' ({hint}){missing}.")
