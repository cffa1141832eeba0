"""Pictures, plots and tables."""

import os

import numpy as np
import pytest
import torch
from PIL import Image
from rich.console import Console

from difftetvr.errors import CaptureError
from difftetvr.fitting.records.evaluation import Evaluation
from difftetvr.fitting.records.history import History, MoveTotals, RefinementRecord
from difftetvr.fitting.records.progress import ProgressDisplay
from difftetvr.fitting.records.result import Progress
from difftetvr.mesh import Field, TetMesh
from difftetvr.view.describe import data_table, evaluation_table, mesh_tables
from difftetvr.view.pictures import comparison, save_comparisons, save_png
from difftetvr.view.plots import save_curves


def text_of(*renderables):
    console = Console(width=100, record=True, file=open(os.devnull, "w"))  # noqa: SIM115
    for renderable in renderables:
        console.print(renderable)
    return console.export_text()


def test_png_holds_rounded_linear_values(tmp_path):
    image = torch.tensor([[[0.0, 1.0, 0.5], [-1.0, 2.0, 0.25]]])
    save_png(tmp_path / "a.png", image)
    pixels = np.asarray(Image.open(tmp_path / "a.png"))
    assert pixels.tolist() == [[[0, 255, 128], [0, 255, 64]]]
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]


@pytest.mark.parametrize("name", ["a.jpg", "a", "missing/a.png"])
def test_pictures_that_cannot_be_written(tmp_path, name):
    with pytest.raises(CaptureError, match=r"PNG|Cannot write"):
        save_png(tmp_path / name, torch.zeros(4, 4, 3))
    assert not list(tmp_path.iterdir())


def test_comparison_shows_truth_reconstruction_and_difference():
    truth = torch.zeros(64, 64, 3)
    reconstruction = torch.full((64, 64, 3), 0.1)
    pixels = np.asarray(comparison(truth, reconstruction))
    middle = pixels[pixels.shape[0] - 100]
    third = pixels.shape[1] // 3
    assert middle[third // 2].tolist() == [0, 0, 0]
    assert middle[third + third // 2].tolist() == [26, 26, 26]
    assert middle[2 * third + third // 2].tolist() == [102, 102, 102]
    assert (pixels[:20] < 128).any(), "the label"


def test_comparisons_are_stacked(tmp_path):
    image = torch.rand(300, 200, 3)
    save_comparisons(tmp_path / "one.png", [("truth", image, image, 1.0)])
    save_comparisons(tmp_path / "three.png", [("truth", image, image, 1.0)] * 3)
    one, three = (Image.open(tmp_path / name).size for name in ("one.png", "three.png"))
    assert one[0] == three[0]
    assert three[1] >= 3 * one[1]


@pytest.mark.parametrize("count", [0, 1, 500])
def test_curves(tmp_path, count):
    evaluations = [(100, 12.0), (200, 15.0)] if count > 200 else []
    history = History([1.0 / (i + 1) for i in range(count)], [10.0 + i for i in range(count)], evaluations)
    save_curves(tmp_path / "curves.png", history)
    assert Image.open(tmp_path / "curves.png").size[0] > 500


def test_mesh_tables_say_what_the_mesh_holds():
    mesh = TetMesh.grid((2, 3, 4))
    text = text_of(*mesh_tables("a.vtu", mesh, Field(torch.rand(144, 3), torch.full((144,), 7.0), location="cell")))
    for expected in ("a.vtu", "144", "60", "(0, 0, 0) to (1, 1, 1)", "per cell, 7 to 7", "quality Q"):
        assert expected in text
    without = text_of(mesh_tables("a.vtu", mesh, None)[0])
    assert any("color and density" in line and "none" in line for line in without.splitlines())


def test_names_in_tables_are_no_markup():
    mesh = TetMesh.grid((1, 1, 1))
    for name in ("d[/b].vtu", "x[bold].vtu", ":apple:.vtu"):
        assert name in text_of(mesh_tables(name, mesh, None)[0])


def test_tables_need_no_more_than_ascii_where_there_is_no_more(tmp_path):
    with open(tmp_path / "out", "w", encoding="ascii") as file:
        for table in mesh_tables("a.vtu", TetMesh.grid((2, 2, 2)), None):
            Console(width=100, file=file).print(table)
    assert "#" * 30 in (tmp_path / "out").read_text()


def test_evaluation_table_has_means():
    text = text_of(evaluation_table(Evaluation([3, 8], [20.0, 30.0], [0.5, 0.7])))
    for expected in ("3", "8", "20.00", "30.00", "mean", "25.00", "0.6000"):
        assert expected in text
    assert "-" in text_of(evaluation_table(Evaluation([3], [20.0], [])))


def status(**changes):
    values = {
        "iteration": 1,
        "iterations": 3,
        "loss": 0.01,
        "train_psnr": 20.0,
        "held_out_psnr": None,
        "cells": 12345,
        "moves": MoveTotals(),
        "refinements": 0,
        "last_refinement": None,
        "seconds": 1.0,
        "glanced_views": [],
        "glanced_at": None,
        "reconstruction": None,
    }
    return Progress(**(values | changes))


def test_progress_prints_plain_lines_where_there_is_no_terminal():
    console = Console(width=60, record=True, file=open(os.devnull, "w"))  # noqa: SIM115
    with ProgressDisplay(console) as display:
        for i in (1, 2, 3):
            display(status(iteration=i, held_out_psnr=19.5 if i > 1 else None))
    lines = console.export_text().splitlines()
    assert len(lines) == 2
    for expected in ("3/3", "1.00e-02", "20.00 dB (held out 19.50)", "12,345 cells", "it/s", "0:00 left"):
        assert expected in lines[-1]


def test_progress_draws_a_bar_on_a_terminal():
    console = Console(width=160, record=True, force_terminal=True, file=open(os.devnull, "w"))  # noqa: SIM115
    with ProgressDisplay(console) as display:
        display(status(iteration=50, iterations=100))
    assert "50/100" in console.export_text()


def test_a_narrow_terminal_cuts_the_text_off_before_the_bar():
    console = Console(width=80, record=True, force_terminal=True, file=open("/dev/null", "w"))  # noqa: SIM115
    with ProgressDisplay(console) as display:
        display(status(iteration=2, held_out_psnr=19.5, moves=MoveTotals(50, 9000, 3, 2, 1234)))
    drawn = console.export_text().rpartition("starting")[2].splitlines()[0]
    assert drawn.startswith("━" * 5) and "2/3" in drawn and len(drawn) <= 80


@pytest.mark.parametrize("width", [80, 120])
def test_a_terminal_shows_gains_and_the_time_left(width):
    console = Console(width=width, record=True, force_terminal=True, file=open(os.devnull, "w"))  # noqa: SIM115
    record = RefinementRecord(100, 12000, 12345, 2000, 70, 80, 5, 3e-4, 2e-3, 1.8e-3)
    with ProgressDisplay(console) as display:
        display(status(iteration=1000, iterations=2400, refinements=3))
        display(
            status(
                iteration=1001,
                iterations=2400,
                held_out_psnr=30.0,
                moves=MoveTotals(50, 9000, 3, 2, 1234),
                refinements=4,
                last_refinement=record,
            )
        )
    text = console.export_text()
    for expected in ("left", "12,345 cells", "refinement 4: -70 +80 vertices", "(predicted 3.0e-04)"):
        assert expected in text


def test_progress_tells_of_moves_and_refinements():
    console = Console(width=60, record=True, file=open(os.devnull, "w"))  # noqa: SIM115
    record = RefinementRecord(100, 12000, 12345, 2000, 70, 80, 5, 3e-4, 2e-3, 1.8e-3)
    with ProgressDisplay(console) as display:
        display(status(refinements=3))
        display(status(iteration=3, moves=MoveTotals(50, 9000, 3, 2, 1), refinements=4, last_refinement=record))
    text = console.export_text()
    for expected in (
        "1 move refused",
        "refinement 4: -70 +80 vertices",
        "5 flips",
        "gain 2.0e-04 (predicted 3.0e-04)",
    ):
        assert expected in text


def test_data_tables_show_the_whole_range_of_integers():
    table = data_table(
        {"id": torch.from_numpy(np.array([2**64 - 1, 3], np.uint64))}, {"n": torch.tensor([-(2**63), 7])}
    )
    text = text_of(table)
    assert "3 to 18446744073709551615" in text and "-9223372036854775808 to 7" in text
