"""What all tests share: the `gpu` marker, threads, and the folder of example data."""

import gc
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def pytest_collection_modifyitems(items):
    marked = [item for item in items if item.get_closest_marker("gpu")]
    if marked and not _cuda_works():
        for item in marked:
            item.add_marker(pytest.mark.skip(reason="no CUDA device"))


def _cuda_works() -> bool:
    import drjit
    import torch

    return torch.cuda.is_available() and drjit.has_backend(drjit.JitBackend.CUDA)


@pytest.fixture
def recwarn(recwarn: pytest.WarningsRecorder) -> pytest.WarningsRecorder:
    """Warnings of this test alone: files that others left open warn when they are collected, at whatever moment."""
    gc.collect()
    recwarn.clear()
    return recwarn


@pytest.fixture(autouse=True, scope="module")
def one_torch_thread() -> Iterator[None]:
    """Run torch on one thread: small tensors gain nothing from more, which only get in the way of the kernels'."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(autouse=True, scope="session")
def share_of_the_cores() -> None:
    """Let kernels of each of several test processes use its share of the cores: more threads wait for each other."""
    processes = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    if processes > 1:
        from difftetvr.backend import dr

        dr.set_thread_count(max(1, (os.cpu_count() or 1) // processes))


@pytest.fixture
def kernel_threads() -> Iterator[None]:
    """For tests of what threads could upset: run kernels on at least two."""
    from difftetvr.backend import dr

    threads = dr.thread_count()
    dr.set_thread_count(max(2, threads))
    yield
    dr.set_thread_count(threads)


@pytest.fixture(scope="session")
def two_processes() -> Callable[..., subprocess.CompletedProcess[str]]:
    """Starts a script, or ``-m`` a module, in two processes that know of each other; takes its arguments."""
    if sys.platform == "win32":
        pytest.skip("there PyTorch's launcher needs what its packages are built without")

    def run(*args: object) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
        environment = {**os.environ, "PYTHONPATH": str(ROOT / "src"), "CUDA_VISIBLE_DEVICES": ""}
        return subprocess.run([*command, *map(str, args)], env=environment, capture_output=True, text=True, timeout=600)

    return run


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of data that cannot be part of the project: DIFFTETVR_DATA, else ../shared/data beside the repository."""
    folder = Path(os.environ.get("DIFFTETVR_DATA") or ROOT.parent / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"no folder {folder}; set DIFFTETVR_DATA to the folder of example data")
    return folder
