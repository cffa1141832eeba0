"""How often a host waits for a GPU: counted where the device is emulated, which ``make test-cuda-emulated`` does."""

import sys

import pytest

pytestmark = pytest.mark.gpu

COUNTED = {
    "marching, image": 1,
    "marching, by colours and densities": 1,
    "marching, by vertices, too": 1,
}


BUNDLES = {"bundle of rays, image": 1, "bundle of rays that begin among cells, image": 4}


@pytest.mark.parametrize("name", BUNDLES)
def test_bundles_wait_once_where_they_see_all_of_the_mesh(name: str) -> None:
    if "cuda_emulation.started" not in sys.modules:
        pytest.skip("a GPU's driver does not count")
    from cuda_emulation.host_waits import calls, waits_of

    launches, waits = waits_of(calls()[name])
    assert launches > 0
    assert waits.total() == BUNDLES[name], waits


@pytest.mark.parametrize("name", COUNTED)
def test_a_rendering_and_its_backward_pass_wait_once(name: str) -> None:
    if "cuda_emulation.started" not in sys.modules:
        pytest.skip("a GPU's driver does not count")
    from cuda_emulation.host_waits import calls, waits_of
    from cuda_emulation.transfers import copies_of

    call = calls()[name]
    launches, waits = waits_of(call)
    assert launches > 0
    assert waits.total() == COUNTED[name], waits
    # The camera's pose, of six numbers its intrinsics; back comes what says how great the lists must be.
    copied = {"PyTorch: numbers to the device": 1, "PyTorch: bytes to the device": 64}
    copied |= {"Dr.Jit: numbers to the device": 1, "Dr.Jit: bytes to the device": 24}
    assert copies_of(call) == copied | {"Dr.Jit: numbers to the host": 1, "Dr.Jit: bytes to the host": 64}
