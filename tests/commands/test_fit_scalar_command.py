"""``difftetvr fit --unknown``: what it leaves behind, how it goes on, and what it says of bad input."""

import json

import pytest
from commands.helpers import fails
from PIL import Image

import difftetvr as dtv
from difftetvr import cli

VIEWS = ["--views", "6", "--width", "16", "--height", "16", "--test-every", "3"]
FIT = ["fit", "tooth", "--unknown", "scalar", "-o", "OUT", "--cells", "300", "--iterations", "12", *VIEWS]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a short run."""
    folder = tmp_path_factory.mktemp("scalars")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert cli.main(FIT) == 0
    return folder


def test_what_a_run_leaves_behind(made, monkeypatch, capsys):
    monkeypatch.chdir(made)
    names = {file.name for file in (made / "OUT").iterdir()}
    assert names >= {"model.vtu", "transfer_function.json", "metrics.json", "config.json", "comparison.png", "cut.png"}
    metrics = json.loads((made / "OUT/metrics.json").read_text())
    assert metrics["iterations"] == 12 and metrics["psnr"] > 5.0
    scalar = dtv.mesh.io.load_data("OUT/model.vtu").point_data["scalar"]
    assert 0.0 <= scalar.min() and scalar.max() <= 1.0  # noqa: SIM300
    shown = ["--transfer-function", "OUT/transfer_function.json", "--value-range", "0", "1", "--width", "8"]
    assert cli.main(["render", "OUT/model.vtu", "-o", "a.png", "--height", "8", *shown]) == 0
    assert Image.open("a.png").size == (8, 8)


def test_a_run_is_trained_longer_without_its_options(made, monkeypatch, capsys):
    monkeypatch.chdir(made)
    assert cli.main(["fit", "-o", "OUT", "--resume", "--iterations", "15"]) == 0
    assert json.loads((made / "OUT/metrics.json").read_text())["iterations"] == 15
    sentence = fails(capsys, "fit", "tooth", "-o", "OUT", "--resume", "--unknown", "both", "--iterations", "15")
    assert "unknown = scalar, this run asks for both" in sentence
    assert "already holds a run" in fails(capsys, *FIT)


def test_images_need_the_function_that_they_are_seen_through(made, monkeypatch, capsys):
    monkeypatch.chdir(made)
    dtv.load_capture("tooth", views=6, width=16, height=16, test_every=3).save("views.npz")
    options = ["fit", "views.npz", "-o", "OTHER", "--cells", "300", "--iterations", "4", "--unknown"]
    assert "known transfer function" in fails(capsys, *options, "scalar")
    assert not (made / "OTHER").exists()
    assert cli.main([*options, "both", "--knots", "6"]) == 0
    assert len(dtv.TransferFunction.load("OTHER/transfer_function.json").scalar) == 6
    function = ["--transfer-function", "OTHER/transfer_function.json", "--attenuation", "25", "--overwrite"]
    assert cli.main([*options, "scalar", *function]) == 0
