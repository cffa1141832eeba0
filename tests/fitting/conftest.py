"""A capture small enough to fit in seconds."""

import pytest

from difftetvr.capture import VolumeCapture


@pytest.fixture(scope="session")
def small_capture():
    return VolumeCapture(views=10, width=24, height=24, steps_per_unit=300.0).build()
