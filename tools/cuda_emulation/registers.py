"""Registers, spills and occupancy of kernels that the emulated device has been given, by NVIDIA's own assembler.

    EMULATED_CUDA_DUMP=ptx make test-cuda-emulated
    PYTHONPATH=tools python -m cuda_emulation.registers ptx --ptxas .../bin/ptxas

The assembler needs no GPU; ``pip download nvidia-cuda-nvcc`` has it. Without it only what the PTX itself says is
printed. Kernels without a loop and without atomics are left out.
"""

from __future__ import annotations

import argparse
import re
import subprocess
from dataclasses import dataclass
from pathlib import Path

from cuda_emulation.translation.source import Instruction, KernelSource, Label, kernels_of

_REGISTERS_A_PART = 16384  # of the four parts of a multiprocessor, compute capabilities 8.0 and 9.0
_REGISTERS_AT_ONCE = 256  # a warp gets a multiple of so many
_MOST_WARPS = 64


@dataclass(frozen=True)
class PtxCounts:
    """What the text of a kernel says: instructions, loops, atomics, searches for threads of a warp that agree."""

    instructions: int
    loops: int
    atomics: int
    matches: int

    @staticmethod
    def of(kernel: KernelSource) -> PtxCounts:
        """Count."""
        operations = [item.operation for item in kernel.body if isinstance(item, Instruction)]
        loops = [item for item in kernel.body if isinstance(item, Label) and re.match(r"l_\d+_cond$", item.name)]
        atomics = operations.count("red") + operations.count("atom")
        return PtxCounts(len(operations), len(loops), atomics, operations.count("match"))


def warps_of(registers: int) -> int:
    """Warps that a multiprocessor holds of a kernel whose threads have so many registers."""
    a_warp = -(-32 * registers // _REGISTERS_AT_ONCE) * _REGISTERS_AT_ONCE
    return min(_MOST_WARPS, 4 * (_REGISTERS_A_PART // a_warp))


def assembled(ptxas: str, architecture: str, file: Path) -> str:
    """What the assembler says of a module with one kernel."""
    command = [ptxas, "-v", f"-arch={architecture}", str(file), "-o", "/dev/null"]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        return f"does not assemble: {' '.join(done.stderr.split())[:200]}"
    found = re.search(r"(\d+) bytes spill stores.*Used (\d+) registers(?:.*?(\d+) bytes smem)?", done.stderr, re.DOTALL)
    assert found is not None, done.stderr
    spilled, registers, shared = (int(number or 0) for number in found.groups())
    warps = f"{warps_of(registers)} of {_MOST_WARPS} warps"
    return f"{registers:3} registers, {warps}, {spilled:4} bytes spilled, {shared:5} bytes of shared memory"


def main() -> None:
    """Print a line for each kernel."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="what EMULATED_CUDA_DUMP named")
    parser.add_argument("--ptxas", help="the assembler")
    parser.add_argument("--architecture", default="sm_90", help="of the GPU, at least that of the PTX (sm_90)")
    options = parser.parse_args()
    for file in sorted(options.folder.glob("*.ptx"), key=lambda file: file.stat().st_size, reverse=True):
        kernels = kernels_of(file.read_text())
        counts = PtxCounts.of(kernels[0])
        if len(kernels) > 1 or not (counts.loops or counts.atomics):
            continue
        told = assembled(options.ptxas, options.architecture, file) if options.ptxas else "no assembler named"
        print(
            f"{file.stem}  {counts.instructions:5} instructions, {counts.loops} loops, {counts.atomics:3} atomics, "
            f"{counts.matches:2} matches; {told}",
            flush=True,
        )


if __name__ == "__main__":
    main()
