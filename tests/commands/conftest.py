"""A small run for the tests of the commands."""

import shutil

import pytest
from commands.helpers import FIT, VIEWS

import difftetvr.cli as cli


@pytest.fixture(scope="session")
def run(tmp_path_factory):
    """A finished small run, never written to by the tests."""
    folder = tmp_path_factory.mktemp("run") / "out"
    assert cli.main(["fit", "tooth", "-o", str(folder), *VIEWS, *FIT]) == 0
    return folder


@pytest.fixture(autouse=True)
def same_curves(run, monkeypatch):
    """Gives all other runs the curves of this one: drawing them takes longer than a small run itself."""

    def copy(path, history):
        shutil.copy(run / "curves.png", path)

    monkeypatch.setattr("difftetvr.view.report.save_curves", copy)
