"""What all tests share: the `gpu` marker, one thread for torch, and the folder of example data."""

import os
from collections.abc import Iterator
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


@pytest.fixture(autouse=True, scope="module")
def one_torch_thread() -> Iterator[None]:
    """Run torch on one thread: small tensors gain nothing from more, which only get in the way of the kernels'."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of data that cannot be part of the project: DIFFTETVR_DATA, else ../shared/data beside the repository."""
    folder = Path(os.environ.get("DIFFTETVR_DATA") or ROOT.parent / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"no folder {folder}; set DIFFTETVR_DATA to the folder of example data")
    return folder
