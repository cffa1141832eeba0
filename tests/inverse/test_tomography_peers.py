"""The voxel reconstructions that benchmarks/peers holds against the meshes: their matrices, and what they recover."""

import dataclasses
import math
import sys
from pathlib import Path

import pytest
import torch

from difftetvr.capture import ProjectionCapture, ProjectionGeometry, project_volume

CONE = {
    "type": "cone",
    "views": 20,
    "arc": 360,
    "source_distance": 5,
    "detector_distance": 7,
    "detector": [40, 40],
    "detector_size": [4, 4],
    "volume_size": [2, 2, 2],
}
SIZE = 16
NOISE = 0.02
QUIET = lambda line: None  # noqa: E731


@pytest.fixture
def peers(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks" / "peers"))
    names = ("projector", "scan", "variation", "iterations", "fdk", "voxels")
    yield __import__("tomography_voxels")
    for name in names:
        sys.modules.pop(f"tomography_{name}")


def ball() -> torch.Tensor:
    """(X, Y, Z) a ball off the middle, with a smaller one in it."""
    x = (torch.arange(SIZE) + 0.5) * 2 / SIZE - 1
    place = torch.stack(torch.meshgrid(x, x, x, indexing="ij"), -1)
    inner = (place - torch.tensor([0.3, 0.1, -0.2])).norm(dim=-1) < 0.25
    return torch.where(inner, 0.9, torch.where((place - 0.05).norm(dim=-1) < 0.7, 0.5, 0.0))


@pytest.fixture(scope="module")
def capture():
    """Projections of the ball with a little noise, the geometry told by its numbers."""
    geometry = ProjectionGeometry.from_dict(CONE)
    exact = project_volume(ball(), geometry, device="cpu")
    noisy = exact + NOISE * torch.randn(exact.shape, generator=torch.Generator().manual_seed(1))
    variance, valid = torch.full_like(exact, NOISE**2), torch.ones(exact.shape, dtype=torch.bool)
    valid[3, 20, 18:22] = False
    noisy = torch.where(valid, noisy, 99.0)
    return ProjectionCapture(geometry, noisy, variance, valid, ProjectionCapture.held_out(10, CONE["views"]), "ball")


@pytest.mark.parametrize("parallel", [False, True])
def test_the_transpose_is_that_of_the_projections(peers, parallel):
    kind = {"type": "parallel", "views": 20, "arc": 180} if parallel else {}
    keys = {key: CONE[key] for key in ("detector", "detector_size", "volume_size")} if parallel else CONE
    geometry = ProjectionGeometry.from_dict({**keys, **kind})
    projector, random = peers.VoxelProjector(geometry, SIZE), torch.Generator().manual_seed(2)
    volume, views = torch.rand(SIZE**3, generator=random), [0, 7, 13]
    values = torch.randn(len(views), projector.pixels, generator=random)
    seen, back = projector.forward(volume, views), projector.transpose(values, views)
    expected = float((seen.double() * values).sum())
    assert float((back.double() * volume).sum()) == pytest.approx(expected, abs=1e-5 * float(seen.norm()))
    cube = volume.reshape(SIZE, SIZE, SIZE).permute(2, 1, 0)
    assert torch.allclose(seen.reshape(3, 40, 40), project_volume(cube, geometry, device="cpu")[views], atol=1e-5)
    assert torch.allclose(projector.lengths(views), projector.forward(torch.ones(SIZE**3), views), atol=1e-5)


def test_the_proximal_map_is_the_least_sum(peers):
    """No small change of its result makes the sum of squares and total variation less."""
    size, variation = 6, 0.3
    random = torch.Generator().manual_seed(4)
    metric, wanted = 0.5 + torch.rand(size**3, generator=random), torch.randn(size**3, generator=random)
    proximal = sys.modules["tomography_variation"].VariationProximal(metric, variation, size)
    found = proximal(wanted, 800).double()

    def cost(x):
        cube = x.reshape(size, size, size)
        rises = [torch.diff(cube, dim=k, append=cube.narrow(k, size - 1, 1)) for k in range(3)]
        length = sum(r.square() for r in rises).sqrt().sum()
        return float((0.5 * metric * (x - wanted).square()).sum() + variation * length)

    assert found.min() >= 0.0
    least = cost(found)
    assert least < cost(wanted.clamp_min(0.0).double()) - 1.0
    for k in range(40):
        change = torch.randn(size**3, generator=random).double()
        other = (found + (0.03 if k % 2 else 0.003) * change).clamp_min(0.0)
        flat = 0.98 * found + 0.02 * found.mean()
        assert least < min(cost(other), cost(flat)) + 1e-6


def test_volumes_are_recovered(peers, capture):
    truth = ball()
    bench = peers.Bench(capture, truth, QUIET)
    options = peers.argparse.Namespace(
        sizes=[SIZE], rows=["fdk", "sart", "tv", "blurred"], cutoffs=[1.0], tv=[0.05], truth="ball"
    )
    rows = {row.method.split()[0].rstrip(","): row for row, _ in peers.rows_of(bench, options)}
    assert set(rows) == {"FDK", "OS-SART", "total", "truth"}
    assert rows["OS-SART"].volume_psnr > rows["FDK"].volume_psnr > 25.0
    assert rows["OS-SART"].volume_psnr > 33.0
    assert rows["total"].volume_psnr > rows["OS-SART"].volume_psnr
    assert all(row.unknowns == SIZE**3 for row in rows.values())


def test_the_scale_of_backprojections_is_that_of_the_density(peers, capture):
    volume = sys.modules["tomography_fdk"].feldkamp(peers.VoxelScan.of(capture), SIZE, peers.Feldkamp(1.0))
    away = torch.nn.functional.max_pool3d((ball() != 0.5).float()[None], 3, 1, 1)[0].permute(2, 1, 0)
    middle = away.reshape(-1) == 0.0
    assert int(middle.sum()) > 100
    assert float(volume[middle].mean()) == pytest.approx(0.5, rel=0.03)


def test_coarser_projections_have_the_same_rays_and_less_noise(peers, capture):
    coarse = peers.binned(capture, 2)
    assert coarse.geometry.shape == (20, 20, 20)
    expected = capture.line_integrals.reshape(20, 20, 2, 20, 2).mean((2, 4))
    assert torch.allclose(coarse.line_integrals[coarse.valid], expected[coarse.valid])
    assert int((~coarse.valid).sum()) == 2 and torch.allclose(coarse.variance, torch.tensor(NOISE**2 / 4))
    seen = project_volume(ball(), coarse.geometry, device="cpu")
    fine = project_volume(ball(), capture.geometry, device="cpu").reshape(20, 20, 2, 20, 2).mean((2, 4))
    assert (seen - fine).abs().mean() < 0.01


def test_tables_are_kept(peers, tmp_path):
    rows = [peers.Row("FDK", 8, 512, 1.0, 2.0, 30.0, float("nan"))]
    peers.write_csv(tmp_path / "rows.csv", rows)
    lines = (tmp_path / "rows.csv").read_text().splitlines()
    assert lines[0].split(",") == [field.name for field in dataclasses.fields(peers.Row)]
    assert lines[1] == "FDK,8,512,1.0,2.0,30.0,nan"
    assert peers.table_of(rows, "a scan").row_count == 1


def test_the_phantom_holds_its_bodies(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    phantom = __import__("phantom")
    sys.modules.pop("phantom")
    half = (0.5, 0.3, 0.2)
    plate = phantom.Body(2.0, (0.1, 0.0, -0.1), half, is_plate=True, turn=30, tilt=40)
    ellipsoid = phantom.Body(0.5, (0.1, 0.0, -0.1), half, turn=30, tilt=40)
    voxel = (2 / 24) ** 3
    assert phantom.phantom(24, (plate,)).sum() * voxel == pytest.approx(2.0 * 8 * 0.03, rel=0.01)
    assert phantom.phantom(24, (ellipsoid,)).sum() * voxel == pytest.approx(0.5 * 4 / 3 * math.pi * 0.03, rel=0.01)
    both = phantom.phantom(24, (plate, ellipsoid))
    assert both[13, 12, 10] == 0.5 and both.max() == 2.0 and phantom.phantom(24).max() <= phantom.METAL
