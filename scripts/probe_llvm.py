"""Exit with 0 if Dr.Jit can start its CPU back end here, told of the newest libLLVM that this machine has; else with 3.

Loads `difftetvr.libllvm` by its path: the package itself imports PyTorch, which takes seconds and is not asked about.
"""

import importlib.util
import sys
from pathlib import Path

NO_LLVM = 3  # not 1, with which Python exits when Dr.Jit cannot even be imported


def main() -> int:
    """Ask Dr.Jit."""
    path = Path(__file__).resolve().parents[1] / "src" / "difftetvr" / "libllvm.py"
    spec = importlib.util.spec_from_file_location("libllvm", path)
    assert spec is not None and spec.loader is not None
    libllvm = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(libllvm)
    libllvm.tell_drjit()

    import drjit

    if not drjit.has_backend(drjit.JitBackend.LLVM):
        return NO_LLVM
    print("setup: Dr.Jit runs on LLVM {}.{}.{}".format(*drjit.detail.llvm_version()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
