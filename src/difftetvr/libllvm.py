"""Where this machine keeps libLLVM, the compiler behind Dr.Jit's CPU back end.

Dr.Jit looks for it in two folders of Debian and in Homebrew's, and accepts version 15 or newer. It comes in more places
than that: conda environments, Fedora, Arch, MacPorts, Xcode. This module knows them and tells Dr.Jit through the
environment variable ``DRJIT_LIBLLVM_PATH``, which Dr.Jit reads once, when it is first imported. It needs only Python's
standard library, because the set-up uses it before anything else works.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

MINIMUM_VERSION = 15
"""Oldest major version of LLVM that Dr.Jit can use."""

PATH_VARIABLE = "DRJIT_LIBLLVM_PATH"
"""Environment variable by which a user, or :func:`tell_drjit`, names the library."""

# libLLVM-15.so.1, libLLVM.so.19.1, libLLVM-14.0.6.so.1, libLLVM.dylib; but not libLLVMSPIRVLib.so.15.
_NAME = re.compile(
    r"libLLVM(?:[-.](?P<before>\d+)[\d.]*)?\.(?:so|dylib)(?:\.(?P<after>\d+)[\d.]*(?:-[\w.+-]*)?)?|LLVM-C\.dll"
)
_FOLDER_VERSION = re.compile(r"llvm(?:-toolchain)?[-@/\\]?(\d+)")


def tell_drjit() -> Path | None:
    """Name the newest libLLVM of this machine in ``DRJIT_LIBLLVM_PATH``, unless the user has named one.

    Has no effect after Dr.Jit was imported.

    Returns:
        The library that was named, None if the variable was set already, Dr.Jit is loaded, or nothing was found.
    """
    if os.environ.get(PATH_VARIABLE) or "drjit" in sys.modules:
        return None
    library = newest_libllvm(library_folders())
    if library is not None:
        os.environ[PATH_VARIABLE] = str(library)
    return library


def newest_libllvm(folders: Iterable[Path]) -> Path | None:
    """The libLLVM of the highest version in the given folders; between equals, that of the earlier folder.

    Args:
        folders: Folders to look in, without their subfolders. They need not exist.

    Returns:
        None if there is none of version 15 or newer. A library whose version its name and folder do not tell is
        taken only where no other is found.
    """
    best: tuple[int, Path] | None = None
    for folder in folders:
        for library in _libraries(folder):
            version = libllvm_version(library)
            if version is None:
                version = 0
            elif version < MINIMUM_VERSION:
                continue
            if best is None or version > best[0]:
                best = version, library
    return None if best is None else best[1]


def libllvm_version(library: Path) -> int | None:
    """Major version that a libLLVM's file name, or the folder it lies in, tells; None if they do not."""
    name = _NAME.fullmatch(library.name)
    told = name and (name["before"] or name["after"])
    if not told:
        folder = _FOLDER_VERSION.search(str(library.parent))
        told = folder and folder[1]
    return int(told) if told else None


def library_folders() -> Iterator[Path]:
    """Folders where systems and package managers put libLLVM, the most particular to this Python first."""
    yield Path(sys.prefix, "llvm", "lib")  # where this project's set-up lets conda put it
    for prefix in (sys.prefix, os.environ.get("CONDA_PREFIX")):
        if prefix:
            yield Path(prefix, "lib")
            yield Path(prefix, "Library", "bin")
    if sys.platform == "win32":
        yield Path(os.environ.get("PROGRAMFILES", r"C:\Program Files"), "LLVM", "bin")
    elif sys.platform == "darwin":
        yield from _globbed("/opt/homebrew", "opt/llvm*/lib", "Cellar/llvm*/*/lib")
        yield from _globbed("/usr/local", "opt/llvm*/lib", "Cellar/llvm*/*/lib")
        yield from _globbed("/opt/local/libexec", "llvm-*/lib")
        yield Path("/Library/Developer/CommandLineTools/usr/lib")
    else:
        yield from _globbed("/usr/lib", "*-linux-gnu*", "llvm-*/lib", "llvm*/lib64", "llvm/*/lib64")
        yield from _globbed("/usr/lib64", "llvm*/lib", "llvm*/lib64")
        yield from (Path(folder) for folder in ("/usr/lib64", "/usr/lib", "/usr/local/lib", "/usr/local/lib64"))


def _globbed(folder: str, *patterns: str) -> Iterator[Path]:
    for pattern in patterns:
        yield from sorted(Path(folder).glob(pattern))


def _libraries(folder: Path) -> list[Path]:
    try:
        return sorted(entry for entry in folder.iterdir() if _NAME.fullmatch(entry.name) and entry.is_file())
    except OSError:
        return []
