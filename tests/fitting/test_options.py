"""Options: groups of them, and what JSON they are read from."""

import dataclasses
import typing

import pytest

from difftetvr.errors import FitError, counted
from difftetvr.fitting import FitConfig
from difftetvr.fitting.motion import Motion, VertexOptimizerConfig
from difftetvr.fitting.options import OptionGroup


def test_groups_know_what_they_are_called_in_a_run():
    kinds = typing.get_type_hints(FitConfig)
    groups = {f.name: kinds[f.name] for f in dataclasses.fields(FitConfig) if dataclasses.is_dataclass(kinds[f.name])}
    assert set(groups) >= {"motion", "exchange", "grow", "star"}
    for name, kind in groups.items():
        assert issubclass(kind, OptionGroup)
        assert kind.prefix == f"{name}."


def test_errors_name_options_where_they_are():
    with pytest.raises(FitError, match=r"^The option cap is 0\.5; it must be between 0 and 0\.25\.$"):
        VertexOptimizerConfig(cap=0.5)
    with pytest.raises(FitError, match=r"^The option motion\.cap is 0\.5; it must be between 0 and 0\.25\.$"):
        Motion(cap=0.5)
    with pytest.raises(FitError, match=r"^The option grow\.until is 2; it must be between 0 and 1\.$"):
        FitConfig.from_json({"grow": {"until": 2}})


def test_counting():
    assert [counted(n, "cell") for n in (0, 1, 2, 1200)] == ["0 cells", "1 cell", "2 cells", "1,200 cells"]
    assert [counted(n, "vertex", "vertices") for n in (1, 3)] == ["1 vertex", "3 vertices"]
