"""Freed memory that is kept: by choice, and by an allocator of a GPU that does not need it."""

from __future__ import annotations

import gc
import os
import platform
import weakref
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from difftetvr.backend import dr, get_backend
from difftetvr.memory import kept, tried_twice
from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import Camera, render

SHORTAGES = [
    torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB"),
    RuntimeError("jit_malloc(): out of memory! Could not allocate 64 bytes (backend=cuda, shared=0)."),
]


class Caches:
    """Stands for the allocators; takes note of the order in which they are asked."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, uses_a_gpu: bool = True) -> None:
        self.asked: list[str] = []
        monkeypatch.setattr(torch.cuda, "is_initialized", lambda: uses_a_gpu)
        monkeypatch.setattr(torch.cuda, "synchronize", self._named("synchronize"))
        monkeypatch.setattr(torch.cuda, "empty_cache", self._named("torch"))
        monkeypatch.setattr(dr, "flush_malloc_cache", self._named("Dr.Jit"))

    def _named(self, name: str) -> Callable[[], None]:
        return lambda: self.asked.append(name)


def in_a_loop(error: RuntimeError) -> RuntimeError:
    """What Dr.Jit makes of an error in the body of a loop."""
    outer = RuntimeError("dr.while_loop(): encountered an exception (see above).")
    outer.__cause__ = error
    return outer


def failing(error: BaseException, times: int) -> Callable[[], int]:
    """Raises some times, then answers with the number of calls."""
    calls = []

    def work() -> int:
        calls.append(None)
        if len(calls) <= times:
            raise error
        return len(calls)

    return work


@pytest.mark.parametrize("error", [*SHORTAGES, in_a_loop(SHORTAGES[1])], ids=["torch", "Dr.Jit", "Dr.Jit in a loop"])
def test_both_caches_are_given_back_before_the_second_try(
    error: BaseException, monkeypatch: pytest.MonkeyPatch
) -> None:
    caches = Caches(monkeypatch)
    assert tried_twice(failing(error, 1))() == 2
    assert caches.asked == ["Dr.Jit", "synchronize", "torch"]
    with pytest.raises(type(error)):
        tried_twice(failing(error, 2))()


@pytest.mark.parametrize(
    ("error", "uses_a_gpu"), [(SHORTAGES[0], False), (MemoryError(), False), (RuntimeError("a shape is wrong"), True)]
)
def test_what_cannot_be_mended_is_not_tried_again(
    error: BaseException, uses_a_gpu: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    caches = Caches(monkeypatch, uses_a_gpu)
    with pytest.raises(type(error)):
        tried_twice(failing(error, 1))()
    assert not caches.asked


def test_nothing_of_the_first_try_is_alive_when_caches_are_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Or its tensors would stay where they are."""
    Caches(monkeypatch)
    held: list[weakref.ref[torch.Tensor]] = []
    alive: list[bool] = []

    def work() -> None:
        tensor = torch.zeros(3)
        held.append(weakref.ref(tensor))
        if len(held) == 1:
            raise torch.OutOfMemoryError("CUDA out of memory.")

    monkeypatch.setattr(torch.cuda, "empty_cache", lambda: alive.append(held[0]() is not None))
    gc.disable()
    try:
        tried_twice(work)()
    finally:
        gc.enable()
    assert alive == [False]


@pytest.mark.gpu
@pytest.mark.parametrize("step", ["forward", "backward"])
def test_a_rendering_survives_a_card_that_is_full_until_caches_are_given_back(
    step: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if "EMULATED_CUDA_KERNELS" not in os.environ:
        pytest.skip("only an emulated device's memory can be as small as is asked")
    mesh = TetMesh.grid((3, 3, 3), dtype=torch.float32).to("cuda")
    color = torch.rand(mesh.num_vertices, 3, device="cuda").requires_grad_()
    field = Field(color, torch.ones(mesh.num_vertices, device="cuda"))
    camera = Camera.look_at((2.0, 1.7, 1.4), (0.5, 0.5, 0.5), width=40, height=30)

    def gradient(limited: str | None = None) -> torch.Tensor:
        with monkeypatch.context() as patch:
            for at in ("forward", "backward"):
                if at == limited:
                    patch.setattr(torch.cuda, "empty_cache", lambda: os.environ.pop("EMULATED_CUDA_MEMORY", None))
                    dr.flush_malloc_cache()
                    patch.setenv(
                        "EMULATED_CUDA_MEMORY", str(torch.cuda.mem_get_info()[1] - torch.cuda.mem_get_info()[0])
                    )
                if at == "forward":
                    image = render(mesh, field, camera).color
                else:
                    (found,) = torch.autograd.grad(image.square().sum(), color)
            assert limited is None or "EMULATED_CUDA_MEMORY" not in os.environ
        return found.cpu()

    get_backend("cuda")
    torch.testing.assert_close(gradient(step), gradient())


def pages_taken(floats: int, repetitions: int = 20) -> float:
    """Pages that the system has to hand out for a block of floats, as a share of those that it has."""
    usage = pytest.importorskip("resource")
    blocks = torch.ones(floats), torch.ones(floats)
    del blocks
    before = usage.getrusage(usage.RUSAGE_SELF).ru_minflt
    for _ in range(repetitions):
        torch.ones(floats)
    taken: int = usage.getrusage(usage.RUSAGE_SELF).ru_minflt - before
    return taken / (repetitions * 4 * floats / os.sysconf("SC_PAGE_SIZE"))


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries keep what they like")
def test_large_blocks_are_kept_for_the_next_and_given_back_in_the_end():
    def resident() -> int:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    large, middling = 1 << 25, 5_000_000
    with kept():
        assert pages_taken(large) < 0.25
        most = resident()
    assert resident() < most - 2 * large
    assert pages_taken(middling) < 0.25, "what is handed out again by default is so afterwards"
