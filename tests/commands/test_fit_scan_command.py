"""``difftetvr fit`` of projections: what it leaves behind, how it goes on, and what it says of bad input."""

import json

import numpy as np
import pytest
from commands.helpers import fails
from PIL import Image

import difftetvr as dtv
from difftetvr import cli

GEOMETRY = {
    "type": "cone",
    "views": 12,
    "source_distance": 5,
    "detector_distance": 7,
    "detector": [20, 18],
    "detector_size": [4, 4],
    "volume_size": [2, 2, 2],
    "unit": "mm",
}
FIT = ["fit", "scan.npz", "-o", "OUT", "--cells", "400", "--rays", "400", "--holdout-every", "6", "--solve-steps", "2"]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a volume, its projections and a short run."""
    folder = tmp_path_factory.mktemp("scan")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        x, y, z = np.meshgrid(*[np.linspace(-1, 1, 16)] * 3, indexing="ij")
        np.save("volume.npy", ((x - 0.2) ** 2 + y**2 + z**2 < 0.5).astype(np.float32).transpose(2, 1, 0))
        (folder / "g.json").write_text(json.dumps(GEOMETRY))
        assert (
            cli.main(["project", "volume.npy", "--geometry", "g.json", "--noise", "poisson:1e5", "-o", "scan.npz"]) == 0
        )
        assert cli.main([*FIT, "--iterations", "20", "--truth", "volume.npy"]) == 0
    return folder


@pytest.fixture
def there(made, monkeypatch):
    monkeypatch.chdir(made)
    return made


def test_what_a_run_leaves_behind(there):
    metrics = json.loads((there / "OUT" / "metrics.json").read_text())
    assert metrics["iterations"] == 20 and metrics["cells"] <= 400 and metrics["views"] == [3, 9]
    assert metrics["projection_psnr"] > 15 and metrics["volume_psnr"] > 8
    saved = json.loads((there / "OUT" / "config.json").read_text())
    assert saved["capture"] == "scan.npz" and saved["tomography"]["cells"] == 400
    for name in ("cut", "comparison", "curves"):
        assert np.asarray(Image.open(there / "OUT" / f"{name}.png").convert("L")).std() > 5
    data = dtv.load_data(there / "OUT" / "model.vtu")
    assert float(data.point_data["density"].min()) >= 0


def test_a_run_is_trained_longer_without_naming_the_scan(there, capsys):
    assert cli.main(["fit", "-o", "OUT", "--resume", "--iterations", "30"]) == 0
    said = capsys.readouterr().out
    assert "30/30" in said and "Held out: PSNR" in said
    assert json.loads((there / "OUT" / "metrics.json").read_text())["iterations"] == 30
    assert cli.main(["voxelise", "OUT/model.vtu", "--like", "volume.npy", "-o", "vox.npy"]) == 0
    assert np.load(there / "vox.npy").shape == (16, 16, 16)


def test_the_help_is_that_of_projections_where_some_are_named(there, capsys):
    assert cli.main(["fit", "scan.npz", "--help"]) == 0
    said = capsys.readouterr().out
    assert "--total-variation" in said and "--harmonics" not in said
    assert cli.main(["fit", "--help"]) == 0
    assert "--harmonics" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["fit", "scan.npz", "-o", "OUT"], "already holds a run"),
        (["fit", "scan.npz", "-o", "OUT", "--resume", "--cells", "500"], "cells = 400"),
        (["fit", "scan.npz", "-o", "NEW", "--total-variation", "-1"], "total_variation"),
        (["fit", "scan.npz", "-o", "NEW", "--harmonics", "2"], "harmonics"),
        (
            ["fit", "scan.npz", "-o", "NEW", "--holdout-every", "1"],
            "holdout_every is 1: one of so many views cannot be",
        ),
        (["fit", "scan.npz", "-o", "NEW", "--truth", "none.npy"], "none.npy"),
        (["fit", "missing.h5", "-o", "NEW"], "missing.h5"),
        (["fit", "-o", "NEW", "--config", "OUT/config.json"], "of a run on projections"),
        (["eval", "OUT/model.vtu"], "reconstructed from projections, and eval compares images"),
    ],
)
def test_what_is_refused(there, capsys, words, sentence):
    assert sentence in fails(capsys, *words)
    assert not (there / "NEW").exists()


def test_a_truth_that_is_empty_is_refused(there, capsys):
    np.save("empty.npy", np.zeros((4, 4, 4), np.float32))
    assert "greater than 0 nowhere" in fails(capsys, "fit", "scan.npz", "-o", "NEW", "--truth", "empty.npy")


def test_projections_are_described(there, capsys):
    assert cli.main(["info", "scan.npz"]) == 0
    said = capsys.readouterr().out
    for text in ("training", "line integrals", "from a source", "variance"):
        assert text in said, text
