"""Dr.Jit's flags, of which every thread has its own, carried along to the thread that goes backward.

Autograd has a thread of its own for each GPU. What a caller has set for debugging or measuring, such as
``drjit.JitFlag.KernelHistory``, shall hold for all kernels of a rendering.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import drjit as dr

_OF_DRJIT_ITSELF = (dr.JitFlag.SymbolicScope, dr.JitFlag.FreezingScope, dr.JitFlag.Default)  # where it is, or several
_FLAGS = tuple(flag for flag in dr.JitFlag if flag not in _OF_DRJIT_ITSELF)


def flags_here() -> tuple[bool, ...]:
    """This thread's flags."""
    return tuple([dr.flag(flag) for flag in _FLAGS])


@contextmanager
def with_flags(flags: tuple[bool, ...]) -> Iterator[None]:
    """Let flags of another thread hold in this one."""
    with ExitStack() as stack:
        for flag, is_set, is_set_here in zip(_FLAGS, flags, flags_here(), strict=True):
            if is_set != is_set_here:
                stack.enter_context(dr.scoped_set_flag(flag, is_set))
        yield
