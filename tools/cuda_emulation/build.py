"""Builds the emulated device into ``build/cuda_emulation``, and tells Dr.Jit of it.

Environment:
    EMULATED_CUDA_COMPILER: C compiler; the first of cc, gcc, clang and tcc if not set.
    EMULATED_CUDA_ROUNDING: How kernels round where PTX leaves it open: words of ``contract`` (products and sums are
        fused where the assembler may do it) and ``approximate`` (approximate instructions are off by as much as the
        manual allows); neither if not set.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
BUILD = HERE.parents[1] / "build" / "cuda_emulation"

_C_COMPILERS = ("cc", "gcc", "clang", "tcc")
_CXX_COMPILERS = ("c++", "g++", "clang++")


class BuildError(Exception):
    """The device cannot be built here; a sentence that says what is missing."""


def prepare() -> ctypes.CDLL:
    """Build the driver unless it is there, and set the environment so that Dr.Jit finds it.

    Returns:
        The driver.

    Raises:
        BuildError: There is no compiler, it fails, Dr.Jit was imported before, or this is not Linux on x86-64.
    """
    if "drjit" in sys.modules:
        raise BuildError("Dr.Jit was imported before the emulated CUDA device; prepare the device first.")
    if not sys.platform.startswith("linux") or os.uname().machine != "x86_64":
        raise BuildError("The emulated CUDA device runs on Linux with an x86-64 processor; use such a machine.")
    compiler = os.environ.get("EMULATED_CUDA_COMPILER") or _found(_C_COMPILERS, "C", "gcc")
    folder = BUILD / _key(compiler)
    kernels, library = folder / "kernels", folder / "libcuda.so.1"
    kernels.mkdir(parents=True, exist_ok=True)
    sources = [HERE / "driver" / name for name in ("driver.c", "executor.c")]
    flags = ["-std=gnu11", "-O2", "-Wall", "-shared", "-fPIC", "-fvisibility=hidden"]
    compiled(library, [*shlex.split(compiler), *flags], sources, ["-ldl", "-lpthread"])
    python = f"env PYTHONPATH={shlex.quote(str(HERE.parent))} {shlex.quote(sys.executable)} -S"
    os.environ["EMULATED_CUDA_COMPILER"] = compiler
    os.environ["EMULATED_CUDA_KERNELS"] = str(kernels)
    os.environ["EMULATED_CUDA_TRANSLATE"] = f"{python} -m cuda_emulation.translation"
    os.environ["DRJIT_LIBCUDA_PATH"] = str(library)
    return ctypes.CDLL(str(library))


def cxx_compiler() -> str:
    """A C++ compiler.

    Raises:
        BuildError: There is none.
    """
    return _found(_CXX_COMPILERS, "C++", "g++")


def compiled(library: Path, command: list[str], sources: list[Path], flags: list[str]) -> Path:
    """A library, compiled unless it is there.

    Args:
        library: Where.
        command: Compiler and its flags before the sources.
        sources: What is compiled.
        flags: Flags behind the sources.

    Raises:
        BuildError: The compiler fails; what it printed stands above.
    """
    if library.exists():
        return library
    with tempfile.TemporaryDirectory(dir=library.parent) as folder:
        made = Path(folder) / library.name
        done = subprocess.run([*command, "-o", str(made), *map(str, sources), *flags])
        if done.returncode:
            raise BuildError(f"{command[0]} could not compile {sources[0].name} (see above); try another compiler.")
        made.rename(library)
    return library


def _found(names: tuple[str, ...], language: str, package: str) -> str:
    for name in names:
        if shutil.which(name):
            return name
    raise BuildError(f"The emulated CUDA device needs a {language} compiler and found none; install {package}.")


def _key(compiler: str) -> str:
    """Of all that decides what kernels become, so that none is used that an older translation made."""
    told = [compiler, os.environ.get("EMULATED_CUDA_ROUNDING", "")]
    files = [*sorted(HERE.glob("driver/*")), *sorted(HERE.glob("translation/*.py"))]
    return hashlib.sha256("\0".join([*told, *(file.read_text() for file in files)]).encode()).hexdigest()[:16]
