"""What views show, as the capture keeps it: bytes, floats, masks, images of several sizes, on every device."""

from dataclasses import replace

import pytest
import torch

from difftetvr.capture import Capture
from difftetvr.capture.packed import MixedImages, PackedImages
from difftetvr.capture.truth import Truth
from difftetvr.errors import CaptureError
from difftetvr.rendering import Camera, LensCamera

SIZES = [(20, 24), (20, 24), (13, 9), (40, 8)]
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)]
KINDS = ["floats", "bytes", "floats of several sizes", "bytes of several sizes"]


def values(shape: tuple[int, ...], seed: int, is_bytes: bool) -> torch.Tensor:
    made = torch.randint(0, 256, shape, generator=torch.Generator().manual_seed(seed), dtype=torch.uint8)
    return made if is_bytes else made.float() / 251.0 * 0.98


def capture_of(kind: str, has_masks: bool = True) -> Capture:
    is_mixed, is_bytes = "sizes" in kind, "bytes" in kind
    sizes = SIZES if is_mixed else SIZES[:1] * 4
    images, alphas = ([values((*s, *c), i, is_bytes) for i, s in enumerate(sizes)] for c in ((3,), ()))
    masks = [values(s, 9 + i, True) > 60 for i, s in enumerate(sizes)]

    def table(parts: list[torch.Tensor]) -> torch.Tensor | PackedImages | MixedImages:
        if is_mixed:
            return MixedImages(tuple(parts))
        return PackedImages(torch.stack(parts)) if parts[0].dtype == torch.uint8 else torch.stack(parts)

    eyes = [(2.0, 0.3 * i, 0.5) for i in range(4)]
    cameras = [Camera.look_at(eye, (0.0, 0.0, 0.0), width=w, height=h) for eye, (h, w) in zip(eyes, sizes, strict=True)]
    bounds = torch.tensor([[-0.5] * 3, [0.5] * 3])
    test = torch.tensor([False, False, True, False])
    valid = table(masks) if has_masks else None
    return Capture(cameras, table(images), table(alphas), test, bounds, kind, valid=valid)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("is_kept", [True, False])
@pytest.mark.parametrize("kind", KINDS)
def test_views_are_those_of_the_capture_to_the_bit(kind: str, is_kept: bool, device: str) -> None:
    capture = capture_of(kind)
    truth = Truth(capture, torch.device(device))
    if is_kept:
        truth.keep([0, 1, 2])
    for view in range(4):
        image, alpha = capture.images[view], capture.alphas[view]
        assert truth.image(view).device.type == device
        assert torch.equal(truth.image(view).cpu(), image)
        behind = torch.tensor([0.25, 0.5, 0.1])
        over = truth.image(view, (0.25, 0.5, 0.1)).cpu()
        assert torch.equal(over, image + (1.0 - alpha)[..., None] * behind)
        valid = truth.valid(view)
        assert torch.equal(valid.cpu(), capture.valid[view])
        assert truth.share(view) == truth.counted_share(view) == float(capture.valid[view].float().mean())
        shown = truth.where_valid(view, torch.zeros_like(truth.image(view)), truth.image(view)).cpu()
        assert torch.equal(shown, torch.where(capture.valid[view][..., None], 0.0, image))


@pytest.mark.parametrize("kind", KINDS)
def test_the_cpu_shares_the_capture(kind: str) -> None:
    capture = capture_of(kind)
    truth = Truth(capture, torch.device("cpu")).keep(range(4))
    for view in (3, 0):
        assert truth.valid(view).data_ptr() == capture.valid[view].data_ptr()
        if "floats" in kind:
            assert truth.image(view).data_ptr() == capture.images[view].data_ptr()


def test_without_masks_all_pixels_count() -> None:
    capture = capture_of("bytes", has_masks=False)
    truth = Truth(capture, torch.device("cpu"))
    image = truth.image(1)
    assert truth.valid(1) is None and truth.share(1) == truth.counted_share(1) == 1.0
    assert truth.where_valid(1, image, torch.zeros_like(image)) is image


def test_a_view_without_a_valid_pixel_can_be_divided_by() -> None:
    capture = replace(capture_of("floats"), valid=torch.zeros(4, *SIZES[0], dtype=torch.bool))
    truth = Truth(capture, torch.device("cpu"))
    assert truth.share(0) == 0.0 < truth.counted_share(0) <= 1e-6


def test_other_backgrounds_need_alpha() -> None:
    truth = Truth(replace(capture_of("bytes"), alphas=None), torch.device("cpu"))
    assert truth.image(0).shape == (*SIZES[0], 3)
    with pytest.raises(CaptureError, match=r"The images of 'bytes' have no alpha, .* use a black background"):
        truth.image(0, (1.0, 1.0, 1.0))


@pytest.mark.parametrize("device", DEVICES)
def test_rays_are_those_of_the_cameras(device: str) -> None:
    capture = capture_of("bytes")
    plain = capture.cameras[1]
    pose, numbers = plain.world_to_camera, (plain.fx, plain.fy, plain.cx, plain.cy, plain.width, plain.height)
    bent = LensCamera(pose, *numbers, model="opencv", coefficients=torch.tensor([0.1, -0.02]))
    capture = replace(capture, cameras=[capture.cameras[0], bent, *capture.cameras[2:]])
    truth = Truth(capture, torch.device(device)).keep([0, 1])
    for view in range(4):
        pixels = torch.tensor([0, 7, 8, 3])
        found, expected = truth.rays(view, pixels.to(device)), capture.cameras[view].rays().some(pixels)
        assert found.directions.device.type == device
        torch.testing.assert_close(found.directions.cpu(), expected.directions, rtol=0, atol=1e-15)
        torch.testing.assert_close(found.origins.cpu(), expected.origins, rtol=0, atol=1e-15)
    assert truth.camera(0) is capture.cameras[0]
    assert truth.camera(1).world_to_camera.device.type == device


@pytest.mark.gpu
@pytest.mark.parametrize("kind", KINDS)
def test_views_cross_once_and_as_they_are_kept(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    transfers = pytest.importorskip("cuda_emulation.transfers", reason="a GPU's driver does not count")
    capture = capture_of(kind)
    truth = Truth(capture, torch.device("cuda"))
    sizes = SIZES if "sizes" in kind else SIZES[:1] * 4
    pixel = 1 + 4 * (1 if "bytes" in kind else 4)  # of mask, alpha and three channels
    kept = transfers.copies_of(lambda: truth.keep([0, 1, 2]))
    poses = 2 * 3 * 64  # there, and back for the camera to look at them
    crossed = kept["PyTorch: bytes to the device"] + kept["PyTorch: bytes to the host"]
    assert crossed == pixel * sum(h * w for h, w in sizes[:3]) + poses

    def ask(view: int) -> None:
        truth.image(view), truth.image(view, (1.0, 1.0, 1.0)), truth.valid(view)

    black = transfers.copies_of(lambda: ask(1))
    assert "PyTorch: arrays to the device" not in black and black["PyTorch: bytes to the device"] == 12
    # What is not kept crosses every time that another view has been asked for.
    alone = transfers.copies_of(lambda: ask(3))
    assert alone["PyTorch: bytes to the device"] == pixel * sizes[3][0] * sizes[3][1] + 64 + 12
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device=None: (2 * pixel * 20 * 24, 1 << 30))
    short = Truth(capture, torch.device("cuda"))
    assert transfers.copies_of(lambda: short.keep([0, 1])) == {}
    assert "PyTorch: arrays to the device" in transfers.copies_of(lambda: short.image(1))
    assert torch.equal(short.image(1).cpu(), capture.images[1])
    short.keep([0])
    assert "PyTorch: arrays to the device" not in transfers.copies_of(lambda: short.image(0))
