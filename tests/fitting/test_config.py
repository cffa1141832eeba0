"""Options, schedules and the choice of the grid."""

import dataclasses
import json
from typing import get_args

import pytest

from difftetvr.errors import FitError
from difftetvr.fitting import FitConfig
from difftetvr.fitting.config import LossName, Refine
from difftetvr.fitting.losses import LOSSES
from difftetvr.fitting.refinement import Exchange
from difftetvr.mesh.making.generators import grid_cubes

TOOTH = (103, 94, 161)


def test_options_name_every_loss_and_every_strategy():
    assert set(get_args(LossName)) == set(LOSSES)
    options = FitConfig()
    for name in set(get_args(Refine)) - {"none"}:
        assert FitConfig(refine=name).strategy() == getattr(options, name)


@pytest.mark.parametrize(
    ("cells", "cubes"),
    [
        (5_000, (8, 8, 13)),
        (20_000, (13, 12, 21)),
        (79_000, (21, 19, 33)),
        (303_000, (33, 30, 51)),
        (1_000_000, (49, 45, 76)),
    ],
)
def test_grids_of_the_benchmark(cells, cubes):
    assert grid_cubes(cells, TOOTH) == cubes


@pytest.mark.parametrize("cells", [2_000, 12_345, 250_000])
@pytest.mark.parametrize("extent", [(1, 1, 1), (1, 2, 3), (0.01, 0.013, 0.009)])
def test_grid_is_near_the_budget_and_its_boxes_near_cubes(cells, extent):
    cubes = grid_cubes(cells, extent)
    count = 6 * cubes[0] * cubes[1] * cubes[2]
    assert abs(count - cells) <= 0.1 * cells
    edges = [side / n for side, n in zip(extent, cubes)]
    assert max(edges) / min(edges) < 1.2


def test_smallest_grid():
    assert grid_cubes(1, (1, 1, 5)) == (1, 1, 1)


def test_rate_falls_log_linearly():
    config = FitConfig(iterations=101, rate=0.1, final_rate=0.001)
    assert config.rate_at(0) == pytest.approx(0.1)
    assert config.rate_at(50) == pytest.approx(0.01)
    assert config.rate_at(100) == pytest.approx(0.001)
    assert FitConfig(iterations=1).rate_at(0) == pytest.approx(0.03)


def test_pace_lengthens_the_steps_of_vertices():
    usual = FitConfig(iterations=100, pace=1.0)
    faster = dataclasses.replace(usual, pace=8.0)
    for iteration in (0, 40, 94):
        assert faster.motion_rate_at(iteration) == pytest.approx(8.0 * usual.motion_rate_at(iteration))
    assert faster.motion_rate_at(95) is None
    assert dataclasses.replace(faster, move=False).motion_rate_at(0) is None


@pytest.mark.parametrize("batch", [1, 3, 7])
def test_every_pass_shows_every_view_once(batch):
    config = FitConfig(batch_views=batch)
    seen = [view for iteration in range(14) for view in config.views_at(iteration, 7)]
    passes = [seen[k : k + 7] for k in range(0, len(seen) - 6, 7)]
    assert all(sorted(p) == list(range(7)) for p in passes)
    assert len({tuple(p) for p in passes}) > 1


def test_seed_decides_views_and_backgrounds():
    a, b, other = (FitConfig(background="random", seed=s) for s in (5, 5, 6))
    assert [a.views_at(i, 9) for i in range(9)] == [b.views_at(i, 9) for i in range(9)]
    assert [a.views_at(i, 9) for i in range(9)] != [other.views_at(i, 9) for i in range(9)]
    assert a.background_at(3) == b.background_at(3) != other.background_at(3)
    assert a.background_at(3) != a.background_at(4)


def test_given_backgrounds():
    assert FitConfig(background="white").background_at(5) == (1.0, 1.0, 1.0)
    assert FitConfig(background=(0.1, 0.2, 0.3)).evaluation_background() == (0.1, 0.2, 0.3)
    assert FitConfig(background="random").evaluation_background() == (1.0, 1.0, 1.0)
    assert FitConfig().evaluation_background() == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    "options",
    [
        {"cells": 0},
        {"iterations": 0},
        {"batch_views": 0},
        {"rate": 0.0},
        {"final_rate": float("nan")},
        {"pace": 0.0},
        {"averaging": 1.5},
        {"haze_penalty": -1.0},
        {"initial_color": 2.0},
        {"betas": (0.9, 1.0)},
        {"loss": "l3"},
        {"location": "face"},
        {"background": "grey"},
        {"background": (0.0, 0.0, 2.0)},
        {"grid": (3, 0, 3)},
        {"cells": 10**23},
        {"grid": (2**20, 2**20, 2**20)},
        {"grid": (10**23, 1, 1)},
        {"iterations": 10**23},
        {"seed": 10**23},
    ],
)
def test_options_out_of_range_are_named(options):
    with pytest.raises(FitError, match=next(iter(options))):
        FitConfig(**options)


def test_json_round_trip():
    config = FitConfig(grid=(1, 2, 3), background=(0.5, 0.25, 0.0), device="cpu")
    assert FitConfig.from_json(json.loads(json.dumps(config.to_json()))) == config
    with pytest.raises(FitError, match="'speed'"):
        FitConfig.from_json({"speed": 3})


@pytest.mark.parametrize(
    "values",
    [
        {"cells": "many"},
        {"cells": 2.5},
        {"cells": True},
        {"seed": None},
        {"rate": "fast"},
        {"rate": True},
        {"betas": [0.9]},
        {"betas": [0.9, "0.99"]},
        {"grid": [[1], 2, 3]},
        {"grid": 3},
        {"location": 1},
        {"background": [0.0, 0.5]},
        {"background": {"r": 1}},
        {"deterministic": 1},
        {"device": 0},
    ],
)
def test_saved_options_of_wrong_types_are_named(values):
    with pytest.raises(FitError, match=f"option {next(iter(values))} is "):
        FitConfig.from_json(values)


@pytest.mark.parametrize("values", [None, 3, "cells", [["cells", 3]]])
def test_saved_options_that_are_no_object(values):
    with pytest.raises(FitError, match="no JSON object"):
        FitConfig.from_json(values)


def test_saved_whole_numbers_are_floats_too():
    assert FitConfig.from_json({"rate": 1, "grid": None, "background": [0, 1, 0]}).background == (0, 1, 0)


def test_the_option_that_differs_from_a_saved_run_is_named():
    saved = FitConfig(cells=500)
    saved.require_same_run(FitConfig(cells=500, device="cpu", evaluate_every=7))
    with pytest.raises(FitError, match="has cells = 500, this run asks for 400"):
        saved.require_same_run(FitConfig(cells=400))
    with pytest.raises(FitError, match=r"has exchange\.share = 0\.08, this run asks for 0\.1;"):
        saved.require_same_run(FitConfig(cells=500, exchange=Exchange(share=0.1)))
