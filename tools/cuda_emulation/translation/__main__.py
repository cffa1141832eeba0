"""Makes a shared library of a PTX file: ``python -m cuda_emulation.translation IN.ptx OUT.so``.

Environment, see :mod:`cuda_emulation.build`:
    EMULATED_CUDA_COMPILER: the C compiler.
    EMULATED_CUDA_ROUNDING: ``contract``, ``approximate``, both or none: see there.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

from cuda_emulation.translation.kernel import Kernel
from cuda_emulation.translation.source import kernels_of

_DRIVER = Path(__file__).parents[1] / "driver"
_FLAGS = ("-std=gnu11", "-O1", "-fPIC", "-mfma", "-ffp-contract=off", "-fno-strict-aliasing")


def c_code(ptx: str, rounding: list[str]) -> str:
    """A module in C."""
    head = ["#define APPROXIMATE"] if "approximate" in rounding else []
    kernels = [Kernel(source, "contract" in rounding).code() for source in kernels_of(ptx)]
    return "\n\n".join([*head, '#include "instructions.h"', *kernels, ""])


def main(source: str, target: str) -> None:
    """Translate and compile; the library is there only once it is whole."""
    code = c_code(Path(source).read_text(), os.environ.get("EMULATED_CUDA_ROUNDING", "").split())
    compiler = shlex.split(os.environ["EMULATED_CUDA_COMPILER"])
    flags = () if Path(compiler[0]).name == "tcc" else _FLAGS
    with tempfile.TemporaryDirectory(dir=Path(target).parent) as folder:
        c_file, library = Path(folder) / "kernel.c", Path(folder) / "kernel.so"
        c_file.write_text(code)
        command = [*compiler, *flags, "-w", "-shared", f"-I{_DRIVER}", "-o", str(library), str(c_file), "-lm"]
        subprocess.run(command, check=True)
        library.rename(target)


if __name__ == "__main__":
    main(*sys.argv[1:])
