"""PyTorch tensors that say they are on cuda:0 and live in host memory, handed to and from Dr.Jit without a copy.

As on a GPU, operations that mix devices raise, NumPy takes no such tensor, views that begin in the midst of a packet
stay there, reduced precision of matrix products is heeded, and autograd runs the backward pass on a thread of its own.
``WAITS`` counts the operations for which a host waits, ``TRANSFERS`` what they carry between host and device.
"""

from __future__ import annotations

import ctypes
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch.autograd.function import BackwardCFunction
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map, tree_unflatten

from cuda_emulation import build

WAITS: Counter[str] = Counter()
"""How often a host has waited in PyTorch, by the operation."""

TRANSFERS: Counter[str] = Counter()
"""Copies between the memories of host and device in PyTorch, and their bytes, by what and where to."""

MOST_BYTES_OF_NUMBERS = 512
"""A copy of no more is one of numbers, of more one of an array; the driver counts by the same."""

_ATEN = torch.ops.aten
_MOVES = (_ATEN.copy_.default, _ATEN._to_copy.default)
_INDEXING = (_ATEN.index.Tensor, _ATEN.index_put_.default, _ATEN.index_put.default, _ATEN._index_put_impl_.default)
_WAITING = ("_local_scalar_dense", "nonzero", "unique", "masked_select", "repeat_interleave", "equal", "bincount")
_PRODUCTS = (_ATEN.mm.default, _ATEN.bmm.default, _ATEN.addmm.default, _ATEN.baddbmm.default)
_TF32_DROPS = 13  # of the 23 bits of a float32's fraction


class EmulatedTensor(torch.Tensor):
    """A tensor on cuda:0; ``inner`` holds its values on the CPU."""

    inner: torch.Tensor

    @staticmethod
    def __new__(cls, inner: torch.Tensor) -> EmulatedTensor:
        """Wrap a CPU tensor."""
        self = torch.Tensor._make_wrapper_subclass(
            cls,
            inner.size(),
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
            layout=inner.layout,
            device=torch.device("cuda", 0),
            requires_grad=False,
        )
        self.inner = inner
        return self

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Compute on the CPU."""
        return _run(function, args, kwargs or {})

    def data_ptr(self) -> int:
        """Where the values are."""
        return self.inner.data_ptr()

    def tolist(self) -> Any:
        """The values, which are copied to the host at once."""
        return self.cpu().tolist()

    def __dlpack__(self, **_: Any) -> Any:
        """The values as memory of the device, for Dr.Jit."""
        return _moved_capsule(torch._C._to_dlpack(self.inner), _DLPACK_CUDA)

    def __dlpack_device__(self) -> tuple[int, int]:
        """The device, likewise."""
        return _DLPACK_CUDA, 0


class _Everywhere(TorchDispatchMode):
    """For functions that make tensors on the device, or move them to it."""

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(function, args, kwargs or {})


# ---- Operations


def _run(function: Any, args: Any, kwargs: Any) -> Any:
    kwargs = {name: value for name, value in kwargs.items() if name != "pin_memory"}  # all memory is the host's
    flat, spec = tree_flatten((args, kwargs))
    ours = [x for x in flat if isinstance(x, EmulatedTensor)]
    asked = next((x for x in flat if isinstance(x, torch.device)), None)
    if not ours and (asked is None or asked.type != "cuda"):
        return function(*args, **kwargs)
    if ours:
        _require_one_device(function, args, flat)
    _count_waits(function, args)
    _count_transfers(function, args, kwargs, flat)
    lowered = [_lowered(x) for x in flat]
    if function in _PRODUCTS and torch.backends.cuda.matmul.allow_tf32:
        lowered = [_as_tf32(x) for x in lowered]
    new_args, new_kwargs = tree_unflatten(lowered, spec)
    result = function(*new_args, **new_kwargs)
    if function is _ATEN.copy_.default:
        return args[0]
    if function is _ATEN._to_copy.default and asked is not None and asked.type != "cuda":
        return result
    known = {id(x.inner): x for x in ours}  # what was changed in place is the same tensor as before
    return tree_map(lambda x: _wrapped(x, known) if isinstance(x, torch.Tensor) else x, result)


def _wrapped(tensor: torch.Tensor, known: dict[int, EmulatedTensor]) -> EmulatedTensor:
    return known[id(tensor)] if id(tensor) in known else EmulatedTensor(tensor)


def _require_one_device(function: Any, args: Any, flat: list[Any]) -> None:
    """Scalars may come from the CPU, and so may indices, but not into a tensor that is there itself."""
    message = f"Expected all tensors to be on the same device, but found cuda:0 and cpu ({function.__name__})"
    if function in _INDEXING:
        values = [args[0], *args[2:3]]
        if not isinstance(args[0], EmulatedTensor) or any(_is_stranger(x) for x in values):
            raise RuntimeError(message)
    elif function not in _MOVES and any(_is_stranger(x) for x in flat):
        raise RuntimeError(message)


def _is_stranger(x: Any) -> bool:
    return isinstance(x, torch.Tensor) and not isinstance(x, EmulatedTensor) and x.dim() > 0


def _count_waits(function: Any, args: Any) -> None:
    name = function.__name__
    has_masks = function in _INDEXING and any(x is not None and x.dtype == torch.bool for x in args[1])
    # One number put where a mask is true needs no places.
    fills = has_masks and len(args) > 2 and args[2].numel() == 1
    if (has_masks and not fills) or any(waiting in name for waiting in _WAITING):
        WAITS[name] += 1


def _count_transfers(function: Any, args: Any, kwargs: Any, flat: list[Any]) -> None:
    if function is _ATEN._local_scalar_dense.default:
        _count_transfer("host", args[0])
    elif function in _MOVES:
        is_copy = function is _ATEN.copy_.default
        source, asked = args[1 if is_copy else 0], kwargs.get("device")
        comes_here = isinstance(args[0], EmulatedTensor) if is_copy else asked is not None and asked.type == "cuda"
        stays = not is_copy and asked is None
        if stays or isinstance(source, EmulatedTensor) == comes_here:
            return
        _count_transfer("device" if comes_here else "host", source)
        # Without this word a host waits until a copy is done; into its own memory it does, too, as that is not locked.
        if not (comes_here and (kwargs.get("non_blocking") or (is_copy and args[2:3] == (True,)))):
            WAITS[f"copy to the {'device' if comes_here else 'CPU'}"] += 1
    else:
        # Indices that come from the CPU are copied, but a number by itself is an argument of the kernel.
        for x in flat:
            if _is_stranger(x):
                _count_transfer("device", x)
                WAITS["copy to the device"] += 1


def _count_transfer(target: str, source: torch.Tensor) -> None:
    if source.nbytes:
        TRANSFERS[f"{'arrays' if source.nbytes > MOST_BYTES_OF_NUMBERS else 'numbers'} to the {target}"] += 1
        TRANSFERS[f"bytes to the {target}"] += source.nbytes


def _lowered(x: Any) -> Any:
    if isinstance(x, EmulatedTensor):
        return x.inner
    return torch.device("cpu") if isinstance(x, torch.device) else x


def _as_tf32(x: Any) -> Any:
    """A float32 tensor rounded to ten bits of its fraction."""
    if not isinstance(x, torch.Tensor) or x.dtype != torch.float32:
        return x
    bits = x.contiguous().view(torch.int32)
    return (((bits + (1 << (_TF32_DROPS - 1))) >> _TF32_DROPS) << _TF32_DROPS).view(torch.float32)


# ---- Exchange with Dr.Jit

_DLPACK_CPU, _DLPACK_CUDA = 1, 2
_DEVICE_OFFSET = ctypes.sizeof(ctypes.c_void_p)  # of the device type, behind the pointer to the data

_capsule_pointer = ctypes.pythonapi.PyCapsule_GetPointer
_capsule_pointer.restype, _capsule_pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]


def _moved_capsule(capsule: Any, device: int) -> Any:
    """A capsule whose tensor says that it is on another kind of device."""
    ctypes.c_int32.from_address(_capsule_pointer(capsule, b"dltensor") + _DEVICE_OFFSET).value = device
    return capsule


def _with_emulated(from_dlpack: Callable[..., torch.Tensor]) -> Callable[..., torch.Tensor]:
    def taken(source: Any, *args: Any, **kwargs: Any) -> torch.Tensor:
        if not hasattr(source, "__dlpack_device__") or source.__dlpack_device__()[0] != _DLPACK_CUDA:
            return from_dlpack(source, *args, **kwargs)
        return EmulatedTensor(torch._C._from_dlpack(_moved_capsule(source.__dlpack__(), _DLPACK_CPU)))

    return taken


# ---- What torch.cuda says


class EmulatedStream:
    """A stream on which all is done at once."""

    cuda_stream = 0

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Take what ``torch.cuda.Stream`` takes."""

    def synchronize(self) -> None:
        """Wait."""
        WAITS["synchronize"] += 1

    def wait_stream(self, stream: EmulatedStream) -> None:
        """Let the device wait."""


_streams = [EmulatedStream()]  # the current one is the last, the default one the first


@contextmanager
def _in_stream(stream: EmulatedStream) -> Iterator[None]:
    _streams.append(stream)
    try:
        yield
    finally:
        _streams.pop()


def _replace_cuda_module(driver: ctypes.CDLL) -> None:
    def memory(device: Any = None) -> tuple[int, int]:
        free, total = ctypes.c_size_t(), ctypes.c_size_t()
        driver.cuMemGetInfo_v2(ctypes.byref(free), ctypes.byref(total))
        return free.value, total.value

    replacements: dict[str, Any] = {
        "_lazy_init": lambda: None,
        "is_available": lambda: True,
        "is_initialized": lambda: True,
        "is_current_stream_capturing": lambda: False,
        "device_count": lambda: 1,
        "current_device": lambda: 0,
        "get_device_name": lambda device=None: "emulated device",
        "mem_get_info": memory,
        "empty_cache": lambda: None,
        "synchronize": lambda device=None: _streams[-1].synchronize(),
        "current_stream": lambda device=None: _streams[-1],
        "default_stream": lambda device=None: _streams[0],
        "Stream": EmulatedStream,
        "stream": _in_stream,
    }
    for name, replacement in replacements.items():
        setattr(torch.cuda, name, replacement)


def _in_backward_thread(apply: Callable[..., Any]) -> Callable[..., Any]:
    """Functions of autograd make tensors on the device from its thread, too."""

    def applied(self: Any, *gradients: Any) -> Any:
        torch._C._set_only_lift_cpu_tensors(True)
        with _Everywhere():
            return apply(self, *gradients)

    return applied


def install(driver: ctypes.CDLL) -> None:
    """Give PyTorch the device, for the rest of the process.

    Args:
        driver: What :func:`cuda_emulation.build.prepare` returns.

    Raises:
        BuildError: There is no C++ compiler, or it fails.
    """
    torch_folder = Path(torch.__file__).parent
    library = Path(driver._name).parent / f"torch_device-{torch.__version__}.so"
    flags = ["-std=c++20", "-O1", "-shared", "-fPIC", f"-I{torch_folder / 'include'}"]
    libraries = [f"-L{torch_folder / 'lib'}", "-ltorch_cpu", "-lc10"]
    source = build.HERE / "driver" / "torch_device.cpp"
    compiler = [] if library.exists() else [build.cxx_compiler()]
    build.compiled(library, [*compiler, *flags], [source], libraries)
    ctypes.CDLL(str(library)).add_emulated_cuda_device()
    torch._C._set_only_lift_cpu_tensors(True)  # torch.tensor(..., device="cuda") copies by an operation that is seen
    _replace_cuda_module(driver)
    torch.utils.dlpack.from_dlpack = _with_emulated(torch.utils.dlpack.from_dlpack)
    BackwardCFunction.apply = _in_backward_thread(BackwardCFunction.apply)
    _Everywhere().__enter__()
