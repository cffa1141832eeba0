"""A small run for the tests of the commands."""

import pytest
from commands.helpers import FIT, VIEWS

import difftetvr.cli as cli


@pytest.fixture(scope="session")
def run(tmp_path_factory):
    """A finished small run, never written to by the tests."""
    folder = tmp_path_factory.mktemp("run") / "out"
    assert cli.main(["fit", "tooth", "-o", str(folder), *VIEWS, *FIT]) == 0
    return folder
