"""Reconstructions that begin with the mesh of a file."""

import dataclasses
import json

import numpy as np
import pytest
import torch

import difftetvr.cli as cli
from difftetvr.errors import FitError, MeshError
from difftetvr.fitting import FitConfig, fit
from difftetvr.fitting.refinement import Exchange
from difftetvr.fitting.trainer import Trainer
from difftetvr.mesh import Field, TetMesh
from difftetvr.mesh.io import save

VIEWS = ["--views", "10", "--width", "24", "--height", "24"]


@pytest.fixture
def grid(small_capture):
    lower, upper = small_capture.bounds.tolist()
    return TetMesh.grid((3, 3, 4), lower, upper)


def write(path, vertices, tets, **arrays):
    np.savez(path, vertices=np.asarray(vertices), tets=np.asarray(tets), **arrays)
    return str(path)


@pytest.fixture
def plain(grid, tmp_path):
    return write(tmp_path / "plain.npz", grid.vertices, grid.tets)


@pytest.fixture
def flawed(grid, tmp_path):
    """The grid with a cell twice, and cells around one vertex that use a copy of it."""
    tets = grid.tets.clone()
    tets[20:40][tets[20:40] == 7] = grid.num_vertices
    vertices = torch.cat((grid.vertices, grid.vertices[7:8]))
    color = torch.linspace(0, 1, len(vertices))[:, None].expand(-1, 3)
    color = torch.cat((color[:-1], color[7:8]))
    arrays = {"color": color, "density": 3.0 * color[:, 0], "location": np.array("vertex")}
    return write(tmp_path / "flawed.npz", vertices, torch.cat((tets, tets[:1])), **arrays)


def options(path, **others):
    few_rounds = Exchange(rounds=3, views=3)
    given = {"initial_mesh": path, "iterations": 3, "device": "cpu", "refine": "none", "exchange": few_rounds}
    return FitConfig(**{**given, **others})


def test_a_run_begins_with_the_mesh_and_is_its_own_budget(small_capture, grid, plain):
    trainer = Trainer(small_capture, options(plain, refine="exchange"))
    assert torch.equal(trainer.mesh.tets, grid.tets)
    assert torch.equal(trainer.mesh.vertices, grid.vertices)
    assert trainer.budget == grid.num_cells
    assert (trainer.parameters.color == 0.5).all()
    assert trainer.repair is None
    assert Trainer(small_capture, options(plain, refine="grow", cells=1000)).budget == 1000
    with pytest.raises(FitError, match="has 216 cells, more than the 100 that it may grow to"):
        Trainer(small_capture, options(plain, refine="grow", cells=100))


@pytest.mark.parametrize("location", ["vertex", "cell"])
def test_colours_and_densities_of_the_file_are_the_first_values(small_capture, grid, tmp_path, location):
    count = grid.num_vertices if location == "vertex" else grid.num_cells
    field = Field(torch.rand(count, 3), 40 * torch.rand(count), location)
    path = str(tmp_path / "model.vtu")
    save(path, grid, field)
    start = Trainer(small_capture, options(path, location=location)).parameters.detached_field()
    assert torch.equal(start.color, field.color)
    assert torch.allclose(start.density, field.density, rtol=1e-6)
    other = "cell" if location == "vertex" else "vertex"
    with pytest.raises(FitError, match=f"belong to its {location}s; use --location {location}"):
        Trainer(small_capture, options(path, location=other))
    save(path, grid, Field(255 * field.color, field.density, location))
    with pytest.raises(FitError, match="scale them"):
        Trainer(small_capture, options(path, location=location))


def test_flaws_are_refused_or_mended(small_capture, grid, flawed):
    with pytest.raises(MeshError, match=r"have it mended with --repair"):
        Trainer(small_capture, options(flawed))
    trainer = Trainer(small_capture, options(flawed, repair=True))
    assert torch.equal(trainer.mesh.tets, grid.tets)
    assert "1 vertex was merged" in trainer.repair and "1 cell that repeated another" in trainer.repair
    color = torch.linspace(0, 1, grid.num_vertices + 1)[:-1]
    assert torch.equal(trainer.parameters.color[:, 0], color)
    assert torch.allclose(trainer.parameters.detached_field().density, 3 * color)


def test_repair_of_a_valid_mesh_is_the_same_run(small_capture, plain):
    one, other = (fit(small_capture, options(plain, repair=value)) for value in (False, True))
    assert torch.equal(one.field.color, other.field.color)
    assert Trainer(small_capture, options(plain, repair=True)).repair is None


@pytest.mark.parametrize("repair", [False, True])
def test_what_cannot_be_begun_with_is_one_sentence(small_capture, grid, tmp_path, repair):
    vertices, tets = grid.vertices, grid.tets
    far = write(tmp_path / "far.npz", vertices + 100, tets)
    folded = write(
        tmp_path / "folded.npz",
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0.2, 0.2, 2.0]],
        [[0, 1, 2, 3], [0, 1, 2, 4]],
    )
    (tmp_path / "broken.vtu").write_text("<VTKFile")
    for path, error, message in (
        (far, FitError, "so that they overlap"),
        (folded, MeshError, "overlaps"),
        (str(tmp_path / "none.vtu"), MeshError, "no mesh file"),
        (str(tmp_path / "broken.vtu"), MeshError, "broken.vtu"),
    ):
        with pytest.raises(error, match=message) as caught:
            Trainer(small_capture, options(path, repair=repair))
        assert "\n" not in str(caught.value)


def test_options_that_contradict_each_other():
    with pytest.raises(FitError, match="grid"):
        FitConfig(initial_mesh="a.vtu", grid=(1, 2, 3))
    with pytest.raises(FitError, match="repair"):
        FitConfig(repair=True)


@pytest.mark.usefixtures("kernel_threads")
def test_resuming_goes_on_to_the_same_bits_without_the_file(small_capture, flawed, tmp_path):
    config = options(flawed, repair=True, refine="exchange", iterations=8)
    whole = fit(small_capture, config)
    path = tmp_path / "c.safetensors"

    def stop(progress):
        if progress.iteration == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(small_capture, dataclasses.replace(config, checkpoint_seconds=0.0), checkpoint=path, on_progress=stop)
    (tmp_path / "flawed.npz").unlink()
    resumed = fit(small_capture, config, checkpoint=path, resume=True)
    assert torch.equal(resumed.mesh.vertices, whole.mesh.vertices)
    assert torch.equal(resumed.mesh.tets, whole.mesh.tets)
    assert torch.equal(resumed.field.color, whole.field.color)
    assert resumed.history.loss == whole.history.loss
    for change in ({"initial_mesh": "other.vtu"}, {"repair": False}, {"initial_mesh": None, "repair": False}):
        with pytest.raises(FitError, match=r"The saved run has (initial_mesh|repair) = "):
            fit(small_capture, dataclasses.replace(config, **change), checkpoint=path, resume=True)


def test_the_command_prints_and_keeps_what_was_mended(flawed, tmp_path, capsys):
    folder = tmp_path / "out"
    given = ["--initial-mesh", flawed, "--iterations", "2", "--exchange.rounds", "1", "--device", "cpu", *VIEWS]
    assert cli.main(["fit", "tooth", "-o", str(folder), *given]) == 2
    assert "--repair" in capsys.readouterr().err
    assert not folder.exists()
    assert cli.main(["fit", "tooth", "-o", str(folder), *given, "--repair"]) == 0
    printed = capsys.readouterr().out
    assert f"Repaired {flawed}: 1 vertex was merged" in printed
    assert "216 cells, its own colours and densities" in printed
    assert cli.main(["fit", "tooth", "-o", str(folder), "--resume"]) == 0
    config = json.loads((folder / "config.json").read_text())
    assert config["repair"].startswith("1 vertex was merged")
    assert config["fit"]["initial_mesh"] == flawed
