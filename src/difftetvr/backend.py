"""Dr.Jit back ends: which one runs, its array types, and zero-copy exchange with PyTorch.

The kernels are plain Python functions over the array types of a :class:`Backend`; one source runs on LLVM (CPUs), CUDA
and Metal, in float32 and float64. Only kernel modules and the modules that wrap them use this file.
"""

from __future__ import annotations

import importlib
import os
import platform
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import numpy as np
import torch

from difftetvr import libcuda, libllvm
from difftetvr.errors import BackendError, shown

for library in (libllvm, libcuda):
    library.tell_drjit()  # before the first import of Dr.Jit, which looks for them only then

import drjit as dr  # noqa: E402

_DEVICE_BACKENDS = {"cpu": "llvm", "cuda": "cuda", "mps": "metal"}
_TURN = threading.RLock()
_FORKED = threading.Event()  # set in copies of a process in which kernels had run
_PACKET_BYTES = 16
NONE = 0xFFFFFFFF
"""What -1 of tables is in kernels, see :meth:`Backend.uints`: no cell, no half-face, no node of a list."""
_DTYPES = {torch.float32: "", torch.float64: "64"}


class BackendWarning(UserWarning):
    """Something runs slower, or repeats less exactly, than this machine or the caller would have it."""


@dataclass(frozen=True, eq=False)
class Backend:
    """The Dr.Jit array types of one back end at one floating-point precision.

    Attributes:
        name: ``"llvm"``, ``"cuda"`` or ``"metal"``.
        device: PyTorch device whose memory the arrays share.
        dtype: ``torch.float32`` or ``torch.float64``.
        Float: Dr.Jit floating-point array of that precision.
        UInt: Dr.Jit 32-bit unsigned array.
        Int: Dr.Jit 32-bit signed array.
        Bool: Dr.Jit mask array.
        Float2: Vector of two ``Float``, gathered as one packet.
        Float4: Vector of four ``Float``, gathered as one packet.
        Floats: Vector of any number of ``Float``, scattered as one packet.
        UInt2: Vector of two ``UInt``, gathered as one packet.
        UInt4: Vector of four ``UInt``, gathered as one packet.
    """

    name: str
    device: torch.device
    dtype: torch.dtype
    Float: Any
    UInt: Any
    Int: Any
    Bool: Any
    Float2: Any
    Float4: Any
    Floats: Any
    UInt2: Any
    UInt4: Any

    @property
    def is_double(self) -> bool:
        """Whether the kernels run in float64."""
        return self.dtype == torch.float64

    def at(self, dtype: torch.dtype | None) -> Backend:
        """The same in another precision; None: in the best that it knows."""
        return _at(self, dtype) if dtype != self.dtype else self

    def floats(self, tensor: torch.Tensor) -> Any:
        """Flat Dr.Jit view of a floating-point tensor, without a copy if it is contiguous and of this precision.

        Compute what depends on the view with :meth:`run` before the tensor may go away.
        """
        tensor = tensor.detach() if tensor.requires_grad else tensor
        return self.Float(self._ready(tensor if tensor.dtype == self.dtype else tensor.to(self.dtype)))

    def uints(self, tensor: torch.Tensor) -> Any:
        """Flat Dr.Jit view of an int32 tensor as unsigned integers, likewise: -1 becomes `NONE`."""
        ready = self._ready(tensor if tensor.dtype == torch.int32 else tensor.to(torch.int32))
        return self.UInt(ready.view(np.uint32 if self.name == "llvm" else torch.uint32))

    def ints(self, tensor: torch.Tensor) -> Any:
        """Flat Dr.Jit view of an int32 tensor, likewise; on a GPU in half the time that unsigned integers take."""
        return self.Int(self._ready(tensor))

    def opaque(self, value: float) -> Any:
        """A scalar as a device value, so that kernels need no recompilation when it changes."""
        return dr.opaque(self.Float, float(value))

    def opaque_uint(self, value: int) -> Any:
        """An integer as a device value, so that kernels need no recompilation when it changes."""
        return dr.opaque(self.UInt, int(value))

    def lanes(self, count: int) -> Any:
        """The numbers 0 to ``count`` - 1, in memory: of kernels that read them Dr.Jit knows the size."""
        return _lanes(self.UInt, count)

    def constant(self, value: float) -> Any:
        """An integer, or a float of this precision, as a device value that is made once."""
        return _constant(self.UInt if isinstance(value, int) else self.Float, value)

    def run(self, *arrays: Any) -> None:
        """Compute arrays, and wait for them unless PyTorch's work on the GPU waits by itself.

        Dr.Jit lets go of a view when its kernel is launched, not when it is done; without waiting, PyTorch could reuse
        the memory of a temporary tensor that a kernel still reads. Dr.Jit's stream on CUDA and PyTorch's default one
        wait for each other.
        """
        dr.eval(*arrays)
        if self.name != "cuda" or not self._is_on_default_stream:
            dr.sync_thread()

    def tensor(self, array: Any, *shape: int) -> torch.Tensor:
        """PyTorch tensor over a Dr.Jit array's memory, without a copy; computes it first, see :meth:`run`."""
        self.run(array)
        tensor = torch.from_numpy(array.numpy()) if self.name == "llvm" else array.torch()
        return tensor.view(shape) if shape else tensor

    @contextmanager
    def exclusive(self, in_order: bool = False) -> Iterator[None]:
        """Run kernels while no other Python thread does.

        Dr.Jit's pool of threads is one a process, and kernels use all of it, so renderings take turns.

        Args:
            in_order: Whether sums over rays are taken in a fixed order. GPUs cannot: their atomic additions have none.

        Raises:
            BackendError: This process was forked from one that had run kernels.
        """
        require_own_threads()
        _watch_forks()
        if in_order and self.name != "llvm":
            warnings.warn(
                f"deterministic=True does not reach the {self.name} kernels: gradients add up in an order that changes "
                "from run to run; pass deterministic=False, or move the tensors to the CPU.",
                BackendWarning,
                stacklevel=2,
            )
        with _TURN:
            # Values of the forward pass may be asked for by autograd's thread, which Dr.Jit must be told of.
            dr.detail.new_scope(dr.backend_v(self.Float))
            yield

    @contextmanager
    def on_threads(self, count: int | None) -> Iterator[None]:
        """Run kernels on so many CPU threads; None: as many as there are."""
        threads = dr.thread_count()
        if count is None or count == threads:
            yield
            return
        dr.set_thread_count(count)
        try:
            yield
        finally:
            dr.sync_thread()
            dr.set_thread_count(threads)

    @property
    def _is_on_default_stream(self) -> bool:
        """Whether PyTorch works on the stream that waits for Dr.Jit's, and that Dr.Jit's waits for."""
        return bool(torch.cuda.current_stream(self.device) == torch.cuda.default_stream(self.device))

    def _ready(self, tensor: torch.Tensor) -> Any:
        """A tensor's values as kernels can read them: flat, where packets may begin, and written."""
        flat = tensor.contiguous()
        if self.name == "llvm":
            return flat.numpy().reshape(-1)  # the same memory, handed over in half the time
        flat = flat if flat.dim() == 1 else flat.view(-1)
        if self.name == "cuda":
            if flat.data_ptr() % _PACKET_BYTES:
                flat = flat.clone()  # loads of whole packets fault on views that begin in the midst of one
            if not self._is_on_default_stream:
                torch.cuda.current_stream(self.device).synchronize()
        return flat


@cache
def _at(backend: Backend, dtype: torch.dtype | None) -> Backend:
    best = torch.float32 if backend.name == "metal" else torch.float64
    return get_backend(str(backend.device), dtype or best)


@lru_cache(maxsize=32)
def _lanes(uint: Any, count: int) -> Any:
    numbers = dr.arange(uint, count)
    dr.make_opaque(numbers)
    return numbers


@lru_cache(maxsize=256)
def _constant(kind: Any, value: float) -> Any:
    return dr.opaque(kind, value)


def backend_for(tensor: torch.Tensor) -> Backend:
    """Back end that works on a tensor's device at its precision.

    Raises:
        BackendError: See :func:`get_backend`.
    """
    return get_backend(str(tensor.device), tensor.dtype)


def get_backend(device: str = "cpu", dtype: torch.dtype = torch.float32) -> Backend:
    """Back end for a device name (``"cpu"``, ``"cuda"``, ``"mps"``) and a precision.

    Raises:
        BackendError: The device has no Dr.Jit back end, its back end cannot start on this machine, or this process was
            forked from one that had run kernels.
    """
    require_own_threads()
    return _started_backend(device, dtype)


@cache
def _started_backend(device: str, dtype: torch.dtype) -> Backend:
    try:
        torch_device = torch.device(device)
    except (RuntimeError, TypeError) as error:
        raise BackendError(f"There is no device {shown(device)}; use {devices_here()}.") from error
    name = _DEVICE_BACKENDS.get(torch_device.type)
    if name is None:
        raise BackendError(f"Device '{device}' has no Dr.Jit back end; move the tensors to 'cpu', 'cuda' or 'mps'.")
    if name == "cuda" and (torch_device.index or 0) > 0:
        raise BackendError(
            f"Kernels run on the first GPU alone, and the tensors are on '{torch_device}'; start one process for each "
            f"GPU, this one with CUDA_VISIBLE_DEVICES={_visible_name(torch_device.index)}, and use 'cuda:0' in it."
        )
    if dtype not in _DTYPES or (name == "metal" and dtype == torch.float64):
        raise BackendError(f"The {name} kernels cannot run in {dtype}; convert the tensors to torch.float32.")
    if not dr.has_backend(getattr(dr.JitBackend, {"llvm": "LLVM", "cuda": "CUDA", "metal": "Metal"}[name])):
        raise BackendError(_missing_backend(name))
    types = importlib.import_module(f"drjit.{name}")
    suffix = _DTYPES[dtype]
    return Backend(
        name=name,
        device=torch_device,
        dtype=dtype,
        Float=getattr(types, f"Float{suffix}"),
        UInt=types.UInt32,
        Int=types.Int32,
        Bool=types.Bool,
        Float2=getattr(types, f"Array2f{suffix}"),
        Float4=getattr(types, f"Array4f{suffix}"),
        Floats=getattr(types, f"ArrayXf{suffix}"),
        UInt2=types.Array2u,
        UInt4=types.Array4u,
    )


def _visible_name(index: int) -> str:
    """What a GPU that PyTorch counts is called outside of this process, of which some may be hidden from it."""
    names = os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",")
    return names[index].strip() if index < len(names) and names[index].strip() else str(index)


def default_device() -> torch.device:
    """The fastest device whose back end works: CUDA, then Metal, then the CPU.

    Raises:
        BackendError: None works.
    """
    require_own_threads()
    if not torch.cuda.is_available() and libcuda.count_gpus():
        warnings.warn(f"The GPU is left unused: {_why_torch_has_none()}", BackendWarning, stacklevel=2)
    for device in _present_devices():
        try:
            get_backend(device)
            return torch.device(device)
        except BackendError as error:
            if device != "cpu":
                warnings.warn(f"The GPU is left unused: {error}", BackendWarning, stacklevel=2)
    raise BackendError(_missing_backend("llvm"))


def _why_torch_has_none() -> str:
    if torch.version.cuda is None:
        return "this PyTorch is built without CUDA; install one that is built for it."
    return "PyTorch cannot start CUDA; `python -c 'import torch; torch.zeros(1).cuda()'` says why."


def require_own_threads() -> None:
    """Refuse to run in a process that is a copy of one in which kernels had run.

    Raises:
        BackendError: It is.
    """
    if _FORKED.is_set():
        raise BackendError(
            "This process was forked after its parent had rendered, and Dr.Jit's threads do not come along; start "
            "workers by the method 'spawn': multiprocessing.get_context('spawn'), or "
            "DataLoader(multiprocessing_context='spawn')."
        )


@cache
def _watch_forks() -> None:
    """Take note if this process, in which kernels run, is ever copied: a copy would wait for its threads for ever."""
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=_FORKED.set)


def _present_devices() -> list[str]:
    present = {"cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available(), "cpu": True}
    return [name for name, is_here in present.items() if is_here]


def devices_here() -> str:
    """The devices that PyTorch can use on this machine and kernels might run on, for messages."""
    return " or ".join(_present_devices())


@dataclass(frozen=True)
class BackendState:
    """Whether a back end starts here, and on what it runs.

    Attributes:
        name: ``"llvm"``, ``"cuda"`` or ``"metal"``.
        device: PyTorch device that it works on.
        works: Whether it starts.
        text: Libraries, versions, threads and memory; or what keeps it from starting.
        has_doubles: Whether it computes in float64.
    """

    name: str
    device: str
    works: bool
    text: str
    has_doubles: bool


def backend_states() -> list[BackendState]:
    """All back ends, the CPU's first, each with what can be said of it; for bug reports."""
    states = []
    for device, name in _DEVICE_BACKENDS.items():
        try:
            get_backend(device)
            works, text = True, _description(name)
        except Exception as error:  # whatever a broken driver or library raises belongs into the report
            works, text = False, " ".join(str(error).split())
        states.append(BackendState(name, device, works, text, works and name != "metal"))
    return states


def _description(name: str) -> str:
    if name == "llvm":
        version = ".".join(str(number) for number in dr.detail.llvm_version())
        library = os.environ.get(libllvm.PATH_VARIABLE, "found by Dr.Jit itself")
        return f"LLVM {version} ({library}), {dr.thread_count()} threads; PyTorch has {torch.get_num_threads()}"
    if name == "cuda":
        if not torch.cuda.is_available():
            raise BackendError("Dr.Jit can use CUDA here, this PyTorch cannot; install one that is built for CUDA.")
        free, total = (amount / 2**30 for amount in torch.cuda.mem_get_info())
        version = f"CUDA {torch.version.cuda} in PyTorch, driver for {dr.detail.cuda_version()}"
        return f"{torch.cuda.get_device_name()}, {version}, {free:.1f} of {total:.1f} GiB free"
    return "the system's Metal"


def _missing_backend(name: str) -> str:
    if name == "cuda":
        return (
            "The CUDA back end cannot start although PyTorch's can: Dr.Jit finds no driver library that it can use; "
            f"name libcuda.so.1 in {libcuda.PATH_VARIABLE}, or move the tensors to the CPU."
        )
    if name == "metal":
        return "The Metal back end cannot start on this system; move the tensors to the CPU."
    return f"The CPU back end needs a system libLLVM of version 15 or newer and found none: run `{_llvm_command()}`."


def _llvm_command() -> str:
    if platform.system() == "Darwin":
        return "brew install llvm"
    if platform.system() == "Windows":
        return "conda install -c conda-forge llvmdev"
    release = platform.freedesktop_os_release() if hasattr(platform, "freedesktop_os_release") else {}
    family = f"{release.get('ID', '')} {release.get('ID_LIKE', '')}"
    if "debian" in family or "ubuntu" in family:
        return "sudo apt-get install libllvm15"
    if "fedora" in family or "rhel" in family:
        return "sudo dnf install llvm-libs"
    return "conda install -c conda-forge llvmdev"
