"""Runs tests on the emulated device: ``python -m pytest -p cuda_emulation.plugin -m gpu``, ``tools`` on PYTHONPATH."""

from __future__ import annotations

from cuda_emulation.started import DRIVER


def pytest_report_header() -> str:
    """Say on what the tests run."""
    return f"CUDA: emulated by {DRIVER._name}"
