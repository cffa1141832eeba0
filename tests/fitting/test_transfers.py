"""What a fit on a GPU copies between the memories of host and device: counted where the device is emulated."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable

import pytest
import torch

from difftetvr.capture import Capture
from difftetvr.capture.packed import PackedImages
from difftetvr.errors import FitError
from difftetvr.fitting import FitConfig
from difftetvr.fitting.losses import LOSSES
from difftetvr.fitting.trainer import Trainer
from difftetvr.rendering import LensCamera

pytestmark = pytest.mark.gpu

CONFIG = FitConfig(cells=1500, iterations=60, device="cuda", deterministic=False)
RENDERING = Counter(  # the camera, and what says how great lists must be; see tests/rendering/test_host_waits.py
    {
        "PyTorch: numbers to the device": 1,
        "PyTorch: bytes to the device": 64,
        "Dr.Jit: numbers to the device": 1,
        "Dr.Jit: bytes to the device": 24,
        "Dr.Jit: numbers to the host": 1,
        "Dr.Jit: bytes to the host": 64,
    }
)
BACKGROUND = Counter({"PyTorch: numbers to the device": 1, "PyTorch: bytes to the device": 12})
STEP_OF_VERTICES = Counter({"PyTorch: numbers to the host": 1, "PyTorch: bytes to the host": 1})  # gradients are finite
MOVES = Counter({"PyTorch: numbers to the host": 1, "PyTorch: bytes to the host": 40})


@pytest.fixture
def copies_of() -> Callable[[Callable[[], object]], Counter[str]]:
    return pytest.importorskip("cuda_emulation.transfers", reason="a GPU's driver does not count").copies_of


@pytest.fixture(scope="module")
def photos(small_capture: Capture) -> Capture:
    """Photographs with masks and alpha, in bytes."""
    images, alphas = (
        PackedImages((part.clamp(0, 1) * 255).byte()) for part in (small_capture.images, small_capture.alphas)
    )
    valid = torch.rand(len(small_capture.cameras), 24, 24, generator=torch.Generator().manual_seed(0)) > 0.1
    return dataclasses.replace(small_capture, images=images, alphas=alphas, valid=valid)


def losses(count: int) -> Counter[str]:
    """The reading of so many iterations."""
    return Counter({"PyTorch: numbers to the host": 1, "PyTorch: bytes to the host": 16 * count})


@pytest.mark.parametrize("background", ["black", "random"])
@pytest.mark.parametrize("batch", [1, 2])
def test_iterations_copy_numbers_alone_and_read_few_of_them(photos, copies_of, background, batch):
    config = dataclasses.replace(CONFIG, refine="none", background=background, batch_views=batch)
    trainer = Trainer(photos, config)
    assert trainer.mesh.topology.cell_adjacency.is_cuda  # made once, and looked at
    of_view = RENDERING + BACKGROUND + (BACKGROUND if background == "random" else Counter())
    unread = 0
    for iteration in range(config.iterations):
        found = copies_of(trainer.step)
        unread += 1
        expected = sum([of_view] * batch, Counter())
        moves = iteration % 2 == 1 and iteration < 0.95 * config.iterations
        expected += STEP_OF_VERTICES if moves else Counter()
        if iteration % 25 == 0 or iteration == config.iterations - 1:
            expected += losses(unread) + (MOVES if iteration else Counter())
            unread = 0
        assert found == expected, iteration
        assert len(trainer.history.loss) == iteration + 1 - unread
    assert trainer.history.moves.steps == 28


def test_what_is_unread_is_read_before_a_checkpoint(photos, copies_of):
    trainer = Trainer(photos, dataclasses.replace(CONFIG, refine="none"))
    for _ in range(4):
        trainer.step()
    assert len(trainer.history.loss) == 1 and trainer.history.moves.steps == 0
    assert copies_of(trainer.checkpoint) == losses(3) + MOVES
    assert len(trainer.history.loss) == len(trainer.history.psnr) == 4 and trainer.history.moves.steps == 2


@pytest.mark.parametrize("refine", ["exchange", "grow", "star"])
def test_refinements_copy_numbers_alone(photos, copies_of, refine):
    trainer = Trainer(photos, dataclasses.replace(CONFIG, refine=refine))
    while not trainer.history.refinements:
        trainer.step()  # the first one has tables of constants copied
    while len(trainer.history.refinements) < 3:
        found = copies_of(trainer.step)
        assert not [name for name in found if "arrays" in name], found
        # Numbers by themselves, but for the readings and for what says how great lists must be.
        readings = 16 * 25 + 40
        assert found["PyTorch: bytes to the host"] <= 8 * found["PyTorch: numbers to the host"] + readings
        assert found["Dr.Jit: bytes to the host"] <= 64 * found["Dr.Jit: numbers to the host"]
        assert found["PyTorch: bytes to the device"] <= 64 * found["PyTorch: numbers to the device"]


def test_glances_leave_images_where_they_are(photos, copies_of):
    trainer = Trainer(photos, dataclasses.replace(CONFIG, refine="none"))
    found = copies_of(trainer.glance)
    assert len(trainer.history.evaluations) == 1 and trainer.history.evaluations[0][1] > 0.0
    assert not [name for name in found if "arrays" in name], found


def test_rays_of_lenses_are_made_on_the_device(photos, copies_of):
    def bent(camera):
        numbers = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
        return LensCamera(camera.world_to_camera, *numbers, coefficients=torch.tensor([0.05, -0.01]))

    capture = dataclasses.replace(photos, cameras=[bent(camera) for camera in photos.cameras])
    trainer = Trainer(capture, dataclasses.replace(CONFIG, refine="exchange"))
    trainer.step()  # what is the same for all views is copied by the first one
    for _ in range(2):
        found = copies_of(trainer.step)
        assert not [name for name in found if "arrays" in name], found
    assert len(trainer.history.refinements) == 1


@pytest.mark.parametrize("asks", ["step", "checkpoint"])
def test_a_loss_that_is_not_finite_is_told_of_by_its_own_iteration(small_capture, monkeypatch, asks):
    trainer = Trainer(small_capture, dataclasses.replace(CONFIG, refine="none"))
    calls = 0

    def loss(image, truth):
        nonlocal calls
        calls += 1
        return (image - truth).square().mean() * (float("nan") if calls == 4 else 1.0)

    monkeypatch.setitem(LOSSES, trainer.config.loss, loss)
    for _ in range(3):
        trainer.step()
    with pytest.raises(FitError, match=r"^The loss of iteration 3 is not finite; check the images or lower"):
        for _ in range(4):
            trainer.step()
            if asks == "checkpoint":
                trainer.checkpoint()
