"""Packages that benchmarks/peers holds against the meshes: that they see the scan where it is, and what they refuse."""

import sys
from pathlib import Path

import pytest
import torch

from difftetvr.capture import ProjectionCapture, ProjectionGeometry, project_volume
from difftetvr.errors import CaptureError

SIZE, WIDTH = 25, 39
QUIET = lambda line: None  # noqa: E731


@pytest.fixture
def peers(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks" / "peers"))
    names = ("projector", "scan", "variation", "iterations", "fdk", "voxels", "slices", "packages", "axis")
    yield __import__("tomography_packages")
    for name in names:
        sys.modules.pop(f"tomography_{name}", None)


def body(size: int = SIZE) -> torch.Tensor:
    """(X, Y, Z) smooth blobs that no turn and no mirror brings onto themselves."""
    x = (torch.arange(size) + 0.5) * 2 / size - 1
    place = torch.stack(torch.meshgrid(x, x, x, indexing="ij"), -1)
    blobs = (((0.4, 0.1, -0.3), 0.25), ((-0.3, 0.35, 0.2), 0.2), ((-0.1, -0.4, 0.45), 0.3))
    return sum(torch.exp(-(place - torch.tensor(c)).square().sum(-1) / (2 * s * s)) for c, s in blobs)


def scan_of(peers, size: int = SIZE, width: int = WIDTH, views: int = 60, **entries: object):
    """Noise-free parallel projections of the body, in a box of side 2."""
    detector = {"detector": [width, size], "detector_size": [2 * width / size, 2]}
    geometry = {"type": "parallel", "views": views, "arc": 180, "volume_size": [2, 2, 2], **detector, **entries}
    geometry = ProjectionGeometry.from_dict(geometry)
    exact = project_volume(body(size), geometry, device="cpu")
    held_out = ProjectionCapture.held_out(10, views)
    return peers.VoxelScan.of(ProjectionCapture(geometry, exact, None, None, held_out, "blobs"))


def moved(volume: torch.Tensor, axis: int, step: float) -> torch.Tensor:
    """(Z, Y, X) the volume farther along an axis, by Fourier's shift, which blurs nothing."""
    phase = torch.exp(-2j * torch.pi * torch.fft.fftfreq(volume.shape[axis]) * step)
    shape = [-1 if k == axis else 1 for k in range(3)]
    return torch.fft.ifft(torch.fft.fft(volume, dim=axis) * phase.reshape(shape), dim=axis).real


def require_in_place(volume: torch.Tensor, worst: float) -> None:
    """It is the body to so much of its peak in the root mean square, and less so half a voxel away, whichever way."""
    truth = body().permute(2, 1, 0)
    cube = volume.reshape(SIZE, SIZE, SIZE)
    error = float((cube - truth).square().mean().sqrt())
    assert error < worst * float(truth.max())
    for axis in range(3):
        for step in (-0.5, 0.5):
            assert float((moved(cube, axis, step) - truth).square().mean().sqrt()) > 1.5 * error, (axis, step)


@pytest.mark.parametrize("start", [0, 37])
def test_backprojection_of_parallel_rays_is_in_place(peers, start):
    fdk = sys.modules["tomography_fdk"]
    require_in_place(fdk.feldkamp(scan_of(peers, start=start), SIZE, fdk.Feldkamp(1.0)), 0.02)


def test_scikit_image_sees_the_scan_where_it_is(peers):
    pytest.importorskip("skimage")
    require_in_place(peers.sart(scan_of(peers, start=37), peers.PackageSart(0.3, 8), QUIET), 0.02)


def test_mbirjax_sees_the_scan_where_it_is(peers):
    pytest.importorskip("mbirjax")
    require_in_place(peers.mbir(scan_of(peers, start=37), peers.Mbir(2.0, 40.0, 15)), 0.02)


def test_slices_are_the_rows_of_the_detector(peers):
    scan = scan_of(peers, views=10)
    slices = peers.Slices.of(scan)
    assert slices.sinograms.shape == (SIZE, 9, WIDTH) and slices.pitch == pytest.approx(2 / SIZE)
    assert slices.degrees.tolist() == pytest.approx([18.0 * k for k in range(10) if k not in scan.test])
    # At angle 0, columns run along y: sums along x, of voxels as wide as pixels.
    first = (WIDTH - SIZE) // 2
    found = torch.from_numpy(slices.sinograms[:, 0, first : first + SIZE])
    assert 0 not in scan.test and torch.allclose(found, body().sum(0).T, atol=1e-3)
    whole = torch.rand(SIZE, WIDTH, WIDTH)
    volume = slices.volume(whole.numpy()).reshape(SIZE, SIZE, SIZE)
    assert volume[3, 4, 5] == whole[3, first + 5, first + 4]


@pytest.mark.parametrize(
    ("entries", "reason"),
    [
        ({"size": 24}, "24 voxels a side.*half a pixel"),
        ({"width": 40}, "40 pixels in a row.*half a pixel"),
        ({"width": 37}, "37 pixels.*39 columns"),
        ({"detector_offset": [0.04, 0]}, "middle"),
        ({"volume_size": [2, 2, 1.9]}, "as wide as the voxels"),
    ],
)
def test_what_would_be_off_is_refused(peers, entries, reason):
    scan = scan_of(peers, views=10, **entries)
    with pytest.raises(CaptureError, match=reason):
        peers.Slices.of(scan).require_middle_pixel()


def test_rays_of_a_source_are_refused(peers):
    scan = scan_of(peers, views=10, type="cone", arc=360, source_distance=5, detector_distance=7)
    with pytest.raises(CaptureError, match="parallel"):
        peers.Slices.of(scan)


def test_missing_packages_are_named(peers, monkeypatch):
    monkeypatch.setitem(sys.modules, "skimage.transform", None)
    with pytest.raises(CaptureError, match="pip install scikit-image"):
        peers.package("skimage.transform", "scikit-image")


def off_axis_scan() -> tuple[ProjectionCapture, torch.Tensor, float]:
    """Two rows of a body that no turn and no mirror brings onto itself, the axis in pixels from the left edge."""
    values = body()[:, :, [8, 16]]
    pitch = 2 / SIZE
    geometry = {"type": "parallel", "views": 60, "arc": 180, "volume_size": [2, 2, 2 * pitch]}
    geometry |= {"detector": [WIDTH, 2], "detector_size": [WIDTH * pitch, 2 * pitch]}
    parsed = ProjectionGeometry.from_dict(geometry | {"axis_offset": -3 * pitch})
    exact = project_volume(values, parsed, device="cpu")
    capture = ProjectionCapture(parsed, exact, None, None, ProjectionCapture.held_out(10, 60), "blobs")
    return capture, values, 0.5 * WIDTH + 3


def test_slices_about_an_axis_are_where_views_see_them(peers) -> None:
    axis = __import__("tomography_axis")
    capture, values, place = off_axis_scan()
    scan = axis.CenteredRows.of(capture, place)
    edge = (WIDTH - SIZE) // 2
    padded = torch.nn.functional.pad(values, (0, 0, edge, edge, edge, edge)).permute(2, 0, 1).flip(0)
    true = padded.double().numpy() * (2 / SIZE)
    assert scan.held_out_psnr(true) > 80.0
    assert (
        max(scan.held_out_psnr(true[::-1]), scan.held_out_psnr(true[:, ::-1]), scan.held_out_psnr(true[..., ::-1])) < 30
    )


def test_back_projection_about_an_axis_sees_the_scan_where_it_is(peers) -> None:
    pytest.importorskip("skimage")
    axis = __import__("tomography_axis")
    capture, _, place = off_axis_scan()
    right, wrong = (axis.CenteredRows.of(capture, place + shift) for shift in (0.0, 1.0))
    assert right.held_out_psnr(axis.back_projected(right, "ramp")) > 30.0
    assert right.held_out_psnr(axis.back_projected(wrong, "ramp")) < 30.0
    assert right.held_out_psnr(axis.sart(right, peers.PackageSart(passes=2))) > 30.0
