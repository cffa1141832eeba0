"""Importing this starts the emulated device for Dr.Jit and PyTorch; before the project, which imports Dr.Jit."""

from __future__ import annotations

import ctypes

from cuda_emulation import build, torch_device


def _started() -> ctypes.CDLL:
    try:
        driver = build.prepare()
        torch_device.install(driver)
    except build.BuildError as error:
        raise SystemExit(str(error)) from None
    return driver


DRIVER = _started()
"""The driver."""
