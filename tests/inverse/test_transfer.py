"""Transfer functions from images of known scalars."""

import importlib
import json
import signal

import pytest
import torch

import difftetvr as dtv
from difftetvr.inverse import TransferConfig, volume_on_grid

FIT = importlib.import_module("difftetvr.inverse.transfer.fit")
TRUTH = dtv.TransferFunction(
    [0.0, 0.3, 0.4, 0.5, 0.8, 1.0],
    [0.0, 0.0, 0.3, 0.05, 0.05, 0.8],
    [[1.0, 0.0, 0.0], [1.0, 0.2, 0.0], [0.9, 0.6, 0.1], [0.2, 0.8, 0.3], [0.1, 0.3, 0.9], [1.0, 1.0, 1.0]],
)
CONFIG = TransferConfig(knots=12, iterations=60, value_range=(0.0, 1.0), attenuation=12.0)


def capture_of(mesh, field, views=6, size=24, alphas=True):
    cameras = dtv.capture.fibonacci_orbit(views, (0.5, 0.5, 0.5), 2.2, width=size, height=size)
    images = [dtv.render(mesh, field, camera) for camera in cameras]
    color, alpha = (torch.stack([getattr(image, name) for image in images]) for name in ("color", "alpha"))
    test = torch.arange(views) == 2
    bounds = mesh.bounds()
    return dtv.Capture(cameras, color, alpha.clamp(0, 1) if alphas else None, test, bounds, "bumps")


@pytest.fixture(scope="module")
def scene():
    """Waves on a grid, a value for each vertex."""
    mesh = dtv.TetMesh.grid((6, 6, 6))
    x, y, z = mesh.vertices.T
    scalar = (0.5 + 0.25 * torch.sin(5 * x + 2 * y) + 0.25 * torch.cos(4 * z)).clamp(0, 1)
    return mesh, scalar, capture_of(mesh, dtv.ScalarField(scalar, TRUTH, 12.0, (0.0, 1.0)))


def test_the_images_are_explained_and_the_function_is_near_the_truth(scene):
    result = dtv.fit_transfer(*scene, CONFIG)
    assert result.start_quality.mean_psnr < 25.0
    assert result.training.mean_psnr > 32.0 and result.held_out.mean_psnr > 32.0
    assert result.held_out.views == [2] and 2 not in result.training.views
    places = torch.linspace(0.05, 0.9, 30)
    error = (result.transfer_function(places)[1] - TRUTH(places)[1]).abs().mean()
    before = (result.start(places)[1] - TRUTH(places)[1]).abs().mean()
    assert float(error) < 0.25 * float(before)
    assert result.metrics["iterations"] == 60 and json.dumps(result.metrics)


def test_places_of_knots_move_but_keep_their_order_and_their_ends(scene):
    result = dtv.fit_transfer(*scene, TransferConfig(knots=8, iterations=10, attenuation=12.0))
    places = result.transfer_function.scalar
    assert float((places - torch.linspace(0, 1, 8)).abs().max()) > 1e-3
    assert bool((places.diff() > 0).all()) and places[0] == 0.0 and places[-1] == 1.0
    still = dtv.fit_transfer(*scene, TransferConfig(knots=8, iterations=3, move_knots=False))
    assert torch.allclose(still.transfer_function.scalar, torch.linspace(0, 1, 8), atol=1e-6)


def test_a_start_is_where_it_begins(scene):
    result = dtv.fit_transfer(*scene, TransferConfig(knots=51, iterations=1, attenuation=12.0), start=TRUTH)
    assert result.start_quality.mean_psnr > 40.0


def test_images_without_alpha_and_values_of_cells_will_do():
    mesh = dtv.TetMesh.grid((3, 3, 3))
    scalar = torch.linspace(0, 1, mesh.num_cells)
    capture = capture_of(mesh, dtv.ScalarField(scalar, TRUTH, 12.0), alphas=False)
    result = dtv.fit_transfer(mesh, scalar, capture, TransferConfig(knots=8, iterations=30, attenuation=12.0))
    assert result.training.mean_psnr > result.start_quality.mean_psnr + 5.0


def test_a_run_that_was_interrupted_goes_on_to_the_same_function(scene, tmp_path):
    config = TransferConfig(knots=8, iterations=8, batch_views=2)
    whole = dtv.fit_transfer(*scene, config)
    path = tmp_path / "checkpoint.safetensors"

    def stop(status):
        if status.iteration == 3:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        dtv.fit_transfer(*scene, config, checkpoint=path, on_progress=stop)
    seen = []
    resumed = dtv.fit_transfer(*scene, config, checkpoint=path, resume=True, on_progress=seen.append)
    assert [status.iteration for status in seen] == [4, 5, 6, 7, 8]
    assert torch.allclose(resumed.transfer_function.opacity, whole.transfer_function.opacity, atol=1e-5)
    assert torch.equal(resumed.start.color, whole.start.color) and len(resumed.losses) == 8


def test_a_checkpoint_of_another_run_is_refused(scene, tmp_path):
    mesh, scalar, capture = scene
    path = tmp_path / "checkpoint.safetensors"
    config = TransferConfig(knots=4, iterations=1)
    dtv.fit_transfer(*scene, config, checkpoint=path)
    with pytest.raises(dtv.FitError, match="knots = 4, this run asks for 5"):
        dtv.fit_transfer(*scene, TransferConfig(knots=5, iterations=1), checkpoint=path, resume=True)
    with pytest.raises(dtv.FitError, match="other scalars or images"):
        dtv.fit_transfer(mesh, 1.0 - scalar, capture, config, checkpoint=path, resume=True)
    path.write_bytes(b"nothing")
    with pytest.raises(dtv.FitError, match="cannot be read"):
        dtv.fit_transfer(*scene, config, checkpoint=path, resume=True)


def test_cameras_that_see_nothing_are_an_error(scene):
    mesh, scalar, capture = scene
    away = mesh.with_vertices(mesh.vertices + 100.0)
    with pytest.raises(dtv.CaptureError, match="No view of 'bumps' sees the mesh"):
        dtv.fit_transfer(away, scalar, capture, CONFIG)


def test_arguments_of_the_wrong_kind_are_errors(scene):
    mesh, scalar, capture = scene
    with pytest.raises(dtv.MeshError, match="5 scalars"):
        dtv.fit_transfer(mesh, scalar[:5], capture)
    with pytest.raises(dtv.MeshError, match="everywhere"):
        dtv.fit_transfer(mesh, torch.zeros_like(scalar), capture)
    with pytest.raises(dtv.MeshError, match="mesh is"):
        dtv.fit_transfer("mesh", scalar, capture)
    with pytest.raises(dtv.FitError, match="capture is"):
        dtv.fit_transfer(mesh, scalar, "tooth")
    with pytest.raises(dtv.FitError, match="start is"):
        dtv.fit_transfer(mesh, scalar, capture, start="tf.json")


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"knots": 1}, "knots is 1"),
        ({"iterations": 0}, "iterations"),
        ({"rate": 0.0}, "rate"),
        ({"smoothness": -1.0}, "smoothness"),
        ({"attenuation": float("inf")}, "attenuation"),
        ({"value_range": (1.0, 0.0)}, "value_range"),
        ({"move_knots": "yes"}, "move_knots"),
    ],
)
def test_options_out_of_range_are_errors(options, sentence):
    with pytest.raises(dtv.FitError, match=sentence):
        TransferConfig(**options)


def test_a_volume_on_a_grid_has_its_values():
    z, y, x = torch.meshgrid(torch.arange(4.0), torch.arange(3.0), torch.arange(5.0), indexing="ij")
    volume = dtv.Volume((0.1 * x + 0.2 * y + 0.05 * z).numpy())
    mesh, values = volume_on_grid(volume, 10**6)
    assert mesh.num_cells == 6 * 4 * 2 * 3
    places = (mesh.vertices - volume.bounds[0]) / torch.tensor(volume.cell_size, dtype=torch.float32)
    assert torch.allclose(values, places @ torch.tensor([0.1, 0.2, 0.05]), atol=1e-5)
    coarse, _ = volume_on_grid(volume, 50)
    assert coarse.num_cells <= 50
    assert torch.allclose(coarse.bounds(), volume.bounds)
    with pytest.raises(dtv.CaptureError, match="at least 6"):
        volume_on_grid(volume, 5)
