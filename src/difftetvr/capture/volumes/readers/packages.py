"""Packages of the extra ``volumes``, which some files need to be read."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from difftetvr.errors import CaptureError


def package(name: str, path: Path) -> Any:
    """The package of that name.

    Args:
        name: What to import.
        path: The file that needs it.

    Raises:
        CaptureError: It is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise CaptureError(
            f"'{path}' needs the package {name} to be read; pip install 'difftetvr[volumes]' installs it."
        ) from error
