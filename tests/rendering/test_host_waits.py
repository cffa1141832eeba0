"""How often a host waits for a GPU: counted where the device is emulated, which ``make test-cuda-emulated`` does."""

import sys

import pytest

pytestmark = pytest.mark.gpu

PINHOLE = ("marching, image", "marching, by colours and densities", "marching, by vertices, too")
OTHERS = (
    "linked-list, image",
    "linked-list, by vertices, too",
    "projected, image",
    "projected, by vertices, too",
    "bundle of rays, image",
    "bundle of rays that begin among cells, image",
    "cameras of one size",
    "cameras of several sizes",
    "camera on the device",
    "lens",
    "parallel",
    "clip plane",
    "scalars",
    "harmonics",
    "normals",
    "depth_at",
    "transmittance_at",
)


@pytest.mark.parametrize("name", OTHERS)
def test_what_rays_meet_is_waited_for_once_and_found_by_few_kernels(name: str) -> None:
    if "cuda_emulation.started" not in sys.modules:
        pytest.skip("a GPU's driver does not count")
    from cuda_emulation.host_waits import calls, waits_of

    launches, waits = waits_of(calls()[name])
    assert 0 < launches < 50
    assert waits.total() == 1, waits


@pytest.mark.parametrize("name", PINHOLE)
def test_a_rendering_and_its_backward_pass_wait_once(name: str) -> None:
    if "cuda_emulation.started" not in sys.modules:
        pytest.skip("a GPU's driver does not count")
    from cuda_emulation.host_waits import calls, waits_of
    from cuda_emulation.transfers import copies_of

    call = calls()[name]
    launches, waits = waits_of(call)
    assert launches > 0
    assert waits.total() == 1, waits
    # The camera's pose, of six numbers its intrinsics; back comes what says how great the lists must be.
    copied = {"PyTorch: numbers to the device": 1, "PyTorch: bytes to the device": 64}
    copied |= {"Dr.Jit: numbers to the device": 1, "Dr.Jit: bytes to the device": 24}
    assert copies_of(call) == copied | {"Dr.Jit: numbers to the host": 1, "Dr.Jit: bytes to the host": 64}


def test_an_idle_device_tells_the_host_again_what_it_told_it() -> None:
    if "cuda_emulation.started" not in sys.modules:
        pytest.skip("a GPU does not know how to be idle")
    from cuda_emulation.host_times import Operations, host_time
    from cuda_emulation.host_waits import calls, waits_of

    call = calls()["bundle of rays, image"]
    launches, _ = waits_of(call)
    before = call().color.cpu()
    with Operations() as counted:
        _, operations, kernels = host_time(call, counted, repetitions=3)
    assert kernels == launches and operations > 0
    assert (call().color.cpu() == before).all()  # at work again
