"""Fitting photographs: what is chosen for them, said, kept, and taken back."""

import json

import numpy as np
import pytest
from capture.photos.photo_scene import dump, write_colmap, write_nerf_synthetic, write_transforms
from commands.helpers import FEW_ROUNDS, fails
from PIL import Image

from difftetvr import cli
from difftetvr.mesh.io import load

FIT = ["--cells", "300", "--iterations", "4", *FEW_ROUNDS, "--evaluate-every", "0", "--device", "cpu"]


def test_fit_says_what_it_chose_for_photographs(tmp_path, capsys):
    """And keeps it with the options, so that the run can be resumed and repeated."""
    generator = np.random.default_rng(0)
    poses = np.tile(np.eye(4, dtype=np.float32), (9, 1, 1))
    poses[:, 2, 3] = 4.0
    poses[:, 0, 3] = np.linspace(-0.2, 0.2, 9)
    images = np.zeros((9, 20, 20, 3), np.float32)
    images[:, 6:14, 6:14] = generator.random((9, 8, 8, 3))
    np.savez(tmp_path / "tiny.npz", images=images, poses=poses, focal=np.float32(25.0))
    bounds = ["--bounds", "-1", "-1", "-1", "1", "1", "1"]
    args = ["fit", str(tmp_path / "tiny.npz"), "-o", str(tmp_path / "out"), *bounds, *FIT]
    assert cli.main(args) == 0
    assert "--harmonics 2" in capsys.readouterr().out
    saved = json.loads((tmp_path / "out" / "config.json").read_text())
    assert saved["fit"]["harmonics"] == 2 and saved["fit"]["background"] == "black"
    assert load(tmp_path / "out" / "model.vtu")[1].harmonics is not None


def test_large_photographs_are_shrunk_and_the_choices_can_be_fed_back(tmp_path, capsys, monkeypatch):
    write_nerf_synthetic(tmp_path / "ball")
    monkeypatch.setattr("difftetvr.cli.options._LONGEST_SIDE", 30)
    out, again = tmp_path / "out", tmp_path / "again"
    options = ["--iterations", "2", "--refine", "none", "--evaluate-every", "0", "--device", "cpu"]
    assert cli.main(["fit", str(tmp_path / "ball"), "-o", str(out), *options]) == 0
    said = capsys.readouterr().out
    assert "Chosen for this machine: --downscale 2\n" in said
    assert "Chosen for these images: --cells 20000, --start hull, --background random" in said
    saved = json.loads((out / "config.json").read_text())
    assert saved["capture_options"] == {"downscale": 2}
    assert (saved["fit"]["cells"], saved["fit"]["start"]) == (20_000, "hull")
    # Other commands read the images as fit did, and compare over the same background.
    assert cli.main(["eval", str(out / "model.vtu"), str(tmp_path / "ball"), "-o", str(tmp_path / "eval.json")]) == 0
    assert "--downscale 2" in capsys.readouterr().out
    metrics = json.loads((out / "metrics.json").read_text())
    assert json.loads((tmp_path / "eval.json").read_text())["psnr"] == pytest.approx(metrics["psnr"], abs=1e-4)
    sheet = tmp_path / "sheet.png"
    assert cli.main(["compare", str(tmp_path / "ball"), str(out / "model.vtu"), "-o", str(sheet), "--no-cut"]) == 0
    assert Image.open(sheet).convert("L").getpixel((5, 200)) == 255
    capsys.readouterr()
    monkeypatch.setattr("difftetvr.cli.options._LONGEST_SIDE", 1000)
    assert cli.main(["fit", "--config", str(out / "config.json"), "-o", str(again)]) == 0
    assert "Chosen" not in capsys.readouterr().out
    assert (again / "config.json").read_bytes() == (out / "config.json").read_bytes()
    assert (again / "model.vtu").read_bytes() == (out / "model.vtu").read_bytes()
    assert cli.main(["fit", str(tmp_path / "ball"), "-o", str(out), "--resume"]) == 0


def test_a_size_that_needs_no_shrinking_is_kept_for_other_machines(tmp_path, monkeypatch):
    write_nerf_synthetic(tmp_path / "ball")
    out, again = tmp_path / "out", tmp_path / "again"
    assert cli.main(["fit", str(tmp_path / "ball"), "-o", str(out), *FIT]) == 0
    monkeypatch.setattr("difftetvr.cli.options._LONGEST_SIDE", 30)
    assert cli.main(["fit", "--config", str(out / "config.json"), "-o", str(again)]) == 0
    assert (again / "model.vtu").read_bytes() == (out / "model.vtu").read_bytes()
    assert cli.main(["fit", str(tmp_path / "ball"), "-o", str(out), "--resume", "--downscale", "1"]) == 0


def test_models_with_harmonics_can_be_exported_without(tmp_path, capsys):
    write_nerf_synthetic(tmp_path / "ball")
    assert cli.main(["fit", str(tmp_path / "ball"), "-o", str(tmp_path / "out"), *FIT]) == 0
    model = tmp_path / "out" / "model.vtu"
    assert "--without-harmonics" in fails(capsys, "export", model, tmp_path / "model.msh")
    assert cli.main(["export", str(model), str(tmp_path / "model.msh"), "--without-harmonics"]) == 0
    assert "without harmonics" in capsys.readouterr().out
    assert load(tmp_path / "model.msh")[1].harmonics is None


def test_a_size_that_is_given_stays(tmp_path, monkeypatch):
    write_nerf_synthetic(tmp_path / "ball")
    monkeypatch.setattr("difftetvr.cli.options._LONGEST_SIDE", 30)
    args = ["fit", str(tmp_path / "ball"), "-o", str(tmp_path / "out"), "--downscale", "1", *FIT]
    assert cli.main(args) == 0
    assert json.loads((tmp_path / "out" / "config.json").read_text())["capture_options"] == {"downscale": 1}


def test_a_start_that_the_images_do_not_allow(tmp_path, capsys):
    write_nerf_synthetic(tmp_path / "ball")
    write_colmap(tmp_path / "room")
    out = tmp_path / "out"
    fit = ("fit", "-o", out, *FIT)
    assert "has no points within its bounds" in fails(capsys, *fit, tmp_path / "ball", "--start", "points")
    assert "Nothing tells" in fails(capsys, *fit, tmp_path / "room", "--start", "hull")
    small = ("--loss", "l1-ssim", "--downscale", "6")
    assert "fewer than the 11 that SSIM" in fails(capsys, *fit, tmp_path / "ball", *small)
    assert not out.exists()


def test_info_says_what_surrounds_the_object(tmp_path, capsys):
    write_colmap(tmp_path / "room")
    assert cli.main(["info", str(tmp_path / "room")]) == 0
    said = capsys.readouterr().out
    assert "surroundings" in said and "times as large" in said and "sparse points" in said


@pytest.mark.parametrize("start", ["grid", "points"])
def test_a_scene_with_a_background_is_fitted_with_its_surroundings(tmp_path, start):
    write_colmap(tmp_path / "room")
    args = ["fit", str(tmp_path / "room"), "-o", str(tmp_path / "out"), *FIT, "--start", start]
    assert cli.main(args) == 0
    mesh, field = load(tmp_path / "out" / "model.vtu")
    lower, upper = mesh.bounds().numpy()
    assert (upper - lower > 8 * 1.4).all() and field.harmonics is not None


def test_lenses_that_are_kept(tmp_path, capsys):
    """By all commands that read photographs; the run and its config.json keep the option."""
    write_transforms(tmp_path / "ball", k1=-0.2, k2=0.05)
    out, again = tmp_path / "out", tmp_path / "again"
    assert cli.main(["fit", str(tmp_path / "ball"), "-o", str(out), "--keep-lens", *FIT]) == 0
    saved = json.loads((out / "config.json").read_text())
    assert saved["capture_options"] == {"downscale": 1, "keep_lens": True}
    metrics = json.loads((out / "metrics.json").read_text())
    model, ball = str(out / "model.vtu"), str(tmp_path / "ball")
    assert cli.main(["eval", model, "-o", str(tmp_path / "kept.json")]) == 0
    assert cli.main(["eval", model, ball, "--no-keep-lens", "-o", str(tmp_path / "resampled.json")]) == 0
    kept, resampled = (json.loads((tmp_path / f"{name}.json").read_text())["psnr"] for name in ("kept", "resampled"))
    assert kept == pytest.approx(metrics["psnr"], abs=1e-4) and kept != pytest.approx(resampled, abs=1e-4)
    assert cli.main(["compare", ball, model, "-o", str(tmp_path / "sheet.png"), "--keep-lens", "--no-cut"]) == 0
    capsys.readouterr()
    assert cli.main(["info", ball, "--keep-lens"]) == 0
    assert "opencv (16 views)" in capsys.readouterr().out
    assert cli.main(["info", ball]) == 0 and "opencv" not in capsys.readouterr().out
    # Options of a run may be turned off again, which is another run then.
    assert cli.main(["fit", ball, "-o", str(out), "--resume"]) == 0
    assert "has other views" in fails(capsys, "fit", ball, "-o", out, "--resume", "--no-keep-lens")
    assert cli.main(["fit", "--config", str(out / "config.json"), "-o", str(again)]) == 0
    assert (again / "model.vtu").read_bytes() == (out / "model.vtu").read_bytes()


def test_fisheyes_need_their_lens(tmp_path, capsys):
    write_transforms(tmp_path / "ball", camera_model="OPENCV_FISHEYE", k1=0.01)
    fit = ("fit", tmp_path / "ball", "-o", tmp_path / "out", *FIT)
    assert "is a fisheye, which no pinhole can stand for; keep it" in fails(capsys, *fit)
    assert not (tmp_path / "out").exists()
    assert cli.main([str(word) for word in (*fit, "--keep-lens")]) == 0
    dump(tmp_path / "config.json", {"capture_options": {"keep_lens": "yes"}})
    wrong = fails(capsys, *fit, "--config", tmp_path / "config.json", "--overwrite")
    assert "capture_options.keep_lens is 'yes'" in wrong
    assert "has no setting 'keep_lens'" in fails(capsys, "fit", "tooth", "-o", tmp_path / "tooth", "--keep-lens")
