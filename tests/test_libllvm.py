"""Finding libLLVM wherever a machine keeps it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from difftetvr import libllvm


def place(folder: Path, *files: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name in files:
        (folder / name).write_text("")
    return folder


@pytest.mark.parametrize(
    ("path", "version"),
    [
        ("/usr/lib/x86_64-linux-gnu/libLLVM-15.so.1", 15),
        ("/usr/lib/x86_64-linux-gnu/libLLVM-14.0.6.so.1", 14),
        ("/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1", 19),
        ("/usr/lib/libLLVM.so.20.1-rust-1.86.0-stable", 20),
        ("/env/lib/libLLVM-18.dylib", 18),
        ("/env/lib/libLLVM.19.1.dylib", 19),
        ("/usr/lib/llvm-17/lib/libLLVM.so", 17),
        ("/opt/homebrew/Cellar/llvm/19.1.7/lib/libLLVM.dylib", 19),
        ("/opt/homebrew/opt/llvm@16/lib/libLLVM.dylib", 16),
        ("/opt/homebrew/opt/llvm/lib/libLLVM.dylib", None),
        ("/Program Files/LLVM/bin/LLVM-C.dll", None),
    ],
)
def test_versions_are_read_from_names(path, version):
    assert libllvm.libllvm_version(Path(path)) == version


def test_the_newest_usable_one_wins(tmp_path):
    debian = place(tmp_path / "debian", "libLLVM-9.so.1", "libLLVM-14.so.1", "libLLVM-15.so.1")
    conda = place(tmp_path / "conda", "libLLVM-19.so", "libLLVM.so.19.1")
    assert libllvm.newest_libllvm([debian]) == debian / "libLLVM-15.so.1"
    assert libllvm.newest_libllvm([debian, tmp_path / "missing", conda]).parent == conda


def test_old_ones_and_other_libraries_do_not_count(tmp_path):
    folder = place(tmp_path, "libLLVM-14.so.1", "libLLVMSPIRVLib.so.15", "libLLVMSupport.a", "libLLVM-15.so.1.debug")
    (folder / "libLLVM-16.so.1").symlink_to("removed")
    assert libllvm.newest_libllvm([folder]) is None


def test_an_unversioned_one_is_the_last_resort(tmp_path):
    plain = place(tmp_path / "plain", "libLLVM.so")
    assert libllvm.newest_libllvm([plain]) == plain / "libLLVM.so"
    versioned = place(tmp_path / "versioned", "libLLVM-15.so.1")
    assert libllvm.newest_libllvm([plain, versioned]).parent == versioned


def tell_drjit_in_new_process(code: str, **environment: str) -> str:
    """What tell_drjit does depends on what was imported before: run it in a Python of its own, without the package."""
    code = f"import os, sys; sys.path.insert(0, {str(Path(libllvm.__file__).parent)!r})\n{code}"
    kept = {name: value for name, value in os.environ.items() if name != libllvm.PATH_VARIABLE}
    command = [sys.executable, "-c", code]
    return subprocess.run(
        command, env={**kept, **environment}, capture_output=True, text=True, check=True
    ).stdout.strip()


def test_drjit_is_told_before_it_is_imported_and_the_user_has_the_last_word(tmp_path):
    newer = place(tmp_path / "lib", "libLLVM-99.so") / "libLLVM-99.so"
    code = "import libllvm; libllvm.tell_drjit(); print(os.environ.get('DRJIT_LIBLLVM_PATH'))"
    assert tell_drjit_in_new_process(code, CONDA_PREFIX=str(tmp_path)) == str(newer)
    assert tell_drjit_in_new_process(code, CONDA_PREFIX=str(tmp_path), DRJIT_LIBLLVM_PATH="/mine.so") == "/mine.so"
    late = f"sys.modules['drjit'] = sys; {code}"
    assert tell_drjit_in_new_process(late, CONDA_PREFIX=str(tmp_path)) == "None"
