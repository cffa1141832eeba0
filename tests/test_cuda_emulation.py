"""The emulated CUDA device itself (tools/cuda_emulation): small kernels whose results the PTX manual tells."""

from __future__ import annotations

import math
import os
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import pytest
from cuda_emulation import build
from cuda_emulation.registers import PtxCounts, warps_of
from cuda_emulation.translation.__main__ import c_code
from cuda_emulation.translation.source import kernels_of

TOOLS = Path(__file__).parents[1] / "tools"

runs_here = pytest.mark.skipif(
    not sys.platform.startswith("linux") or os.uname().machine != "x86_64" or not shutil.which("cc"),
    reason="needs Linux on x86-64 and a C compiler",
)

# Launches the kernel `test` of the PTX file that is named, with one buffer: what comes in is what goes out.
LAUNCH = """
import ctypes, sys
from cuda_emulation import build
driver = build.prepare()
data = ctypes.create_string_buffer(sys.stdin.buffer.read())
module, function = ctypes.c_void_p(), ctypes.c_void_p()
assert driver.cuModuleLoadData(ctypes.byref(module), open(sys.argv[1], "rb").read()) == 0
assert driver.cuModuleGetFunction(ctypes.byref(function), module, b"test") == 0
place = ctypes.c_void_p(ctypes.addressof(data))
arguments = (ctypes.c_void_p * 1)(ctypes.addressof(place))
assert driver.cuLaunchKernel(function, int(sys.argv[2]), 1, 1, int(sys.argv[3]), 1, 1, 0, None, arguments, None) == 0
sys.stdout.buffer.write(data.raw[:-1])
"""

HEAD = """.version 7.0
.target sm_80
.address_size 64
.entry test(.param .u64 data) {
    .reg .b32 %r<40>; .reg .b64 %rd<10>; .reg .f32 %f<20>; .reg .f64 %d<10>; .reg .pred %p<10>;
    ld.param.u64 %rd0, [data];
    mov.u32 %r0, %ctaid.x; mov.u32 %r1, %ntid.x; mov.u32 %r2, %tid.x;
    mad.lo.u32 %r0, %r0, %r1, %r2;
    mad.wide.u32 %rd1, %r0, 4, %rd0;
    ld.global.u32 %r3, [%rd1];
"""
TAIL = "\n    st.global.u32 [%rd1], %r3;\n    ret;\n}\n"


def launched(
    folder: Path, body: str, data: bytes, blocks: int = 1, threads: int = 32, **environment: str
) -> subprocess.CompletedProcess[bytes]:
    """Run a kernel whose every thread has its number in %r0, its word of the data in %r3 and writes %r3 there."""
    file = folder / "test.ptx"
    file.write_text(HEAD + body + TAIL)
    command = [sys.executable, "-c", LAUNCH, str(file), str(blocks), str(threads)]
    variables = {**os.environ, "PYTHONPATH": str(TOOLS), **environment}
    return subprocess.run(command, input=data, env=variables, capture_output=True)


def words(folder: Path, body: str, data: list[int], blocks: int = 1, **environment: str) -> list[int]:
    """The words that a launch over all data makes of them."""
    done = launched(folder, body, struct.pack(f"<{len(data)}I", *data), blocks, len(data) // blocks, **environment)
    assert done.returncode == 0, done.stderr.decode()
    return list(struct.unpack(f"<{len(data)}I", done.stdout))


def bits(number: float) -> int:
    return struct.unpack("<I", struct.pack("<f", number))[0]


@runs_here
def test_threads_of_a_warp_find_each_other(tmp_path: Path) -> None:
    data = [lane % 5 for lane in range(32)]
    body = "activemask.b32 %r4; match.any.sync.b32 %r3, %r3, %r4;"
    assert words(tmp_path, body, data) == [sum(1 << other for other in range(k, 32, 5)) for k in data]
    # Where they have diverged, only those that are together; they meet again behind it.
    body = """setp.ge.u32 %p0, %r0, 20; @%p0 bra other; activemask.b32 %r3; bra both;
        other: mov.u32 %r3, 0; both: vote.sync.ballot.b32 %r5, %p0, -1; add.u32 %r3, %r3, %r5;"""
    low, high = (1 << 20) - 1, 0xFFF << 20
    assert words(tmp_path, body, data) == [low + high] * 20 + [high] * 12
    split = words(tmp_path, "activemask.b32 %r3;", data, EMULATED_CUDA_MASKS="split")
    assert len(set(split)) > 1 and all(
        mask >> lane & 1 and bin(mask).count("1") < 32 for lane, mask in enumerate(split)
    )


@runs_here
def test_shuffles_and_sums_of_a_warp(tmp_path: Path) -> None:
    data = list(range(7, 39))
    for delta in (16, 8, 4, 2, 1):
        assert words(tmp_path, f"shfl.sync.bfly.b32 %r3|%p0, %r3, {delta}, 31, -1;", data)[3] == data[3 ^ delta]
    up = words(tmp_path, "shfl.sync.up.b32 %r4|%p0, %r3, 3, 0, -1; selp.u32 %r3, %r4, 0, %p0;", data)
    assert up == [0, 0, 0, *data[:-3]]
    counted = launched(tmp_path, "atom.global.add.u32 %r3, [%rd0+128], 1;", struct.pack("<33I", *[100] * 33)).stdout
    *before, after = struct.unpack("<33I", counted)
    assert sorted(before) == list(range(100, 132)) and after == 132


@runs_here
@pytest.mark.parametrize("order", ["", "reverse"])
def test_blocks_share_memory_and_wait_for_each_other(order: str, tmp_path: Path) -> None:
    body = """.shared .align 4 .b32 shared[64]; mov.u32 %r4, shared; mad.lo.u32 %r5, %r2, 4, %r4;
        st.shared.u32 [%r5], %r3; bar.sync 0;
        sub.u32 %r6, 63, %r2; mad.lo.u32 %r5, %r6, 4, %r4; ld.shared.u32 %r3, [%r5];"""
    data = list(range(128))
    assert words(tmp_path, body, data, 2, EMULATED_CUDA_ORDER=order) == data[63::-1] + data[:63:-1]


@runs_here
def test_numbers_are_rounded_as_the_manual_says(tmp_path: Path) -> None:
    one, denormal = bits(1.0), 5
    inputs = [bits(x) for x in (math.nan, -0.0, 2.7, -2.7, 1e30, 0.1, 3.0, 1.0)] + [denormal] * 24
    assert words(tmp_path, "mov.b32 %f0, %r3; cvt.rzi.s32.f32 %r3, %f0;", inputs)[:5] == [0, 0, 2, 2**32 - 2, 2**31 - 1]
    least = words(tmp_path, "mov.b32 %f0, %r3; min.f32 %f0, %f0, 0f00000000; mov.b32 %r3, %f0;", inputs)
    assert least[:4] == [0, bits(-0.0), 0, bits(-2.7)]
    flushed = words(tmp_path, "mov.b32 %f0, %r3; add.ftz.f32 %f0, %f0, 0f00000000; mov.b32 %r3, %f0;", inputs)
    assert flushed[8] == 0 and flushed[5] == inputs[5]
    signs = words(tmp_path, "mov.b32 %f0, %r3; copysign.f32 %f0, %f0, 0f3F800000; mov.b32 %r3, %f0;", inputs)
    assert signs[1] == bits(-1.0) and signs[2] == one
    assert words(tmp_path, "mov.b32 %f0, %r3; setp.neu.f32 %p0, %f0, %f0; selp.u32 %r3, 1, 0, %p0;", inputs)[:2] == [
        1,
        0,
    ]


@runs_here
def test_sums_of_products_are_fused_where_that_is_asked_for(tmp_path: Path) -> None:
    product = "mov.b32 %f0, %r3; mul.f32 %f1, %f0, %f0; sub.f32 %f1, %f1, 0f3F800000; mov.b32 %r3, %f1;"
    x = struct.unpack("<f", struct.pack("<f", 1.0 + 2.0**-12))[0]
    separate, fused = bits(2.0**-11), bits(x * x - 1.0)
    assert words(tmp_path, product, [bits(x)] * 32)[0] == separate
    assert words(tmp_path, product, [bits(x)] * 32, EMULATED_CUDA_ROUNDING="contract")[0] == fused


@runs_here
def test_approximate_instructions_are_off_by_little(tmp_path: Path) -> None:
    body = "mov.b32 %f0, %r3; rcp.approx.ftz.f32 %f0, %f0; mov.b32 %r3, %f0;"
    inputs = [bits(1.0 + k / 7.0) for k in range(32)]
    exact = words(tmp_path, body, inputs)
    off = words(tmp_path, body, inputs, EMULATED_CUDA_ROUNDING="approximate")
    assert exact != off and max(abs(one - other) for one, other in zip(exact, off)) <= 1


@runs_here
def test_what_a_gpu_would_fault_at_ends_the_process(tmp_path: Path) -> None:
    done = launched(tmp_path, "ld.global.v2.u32 {%r3, %r4}, [%rd1+4];", bytes(4 * 34))
    assert done.returncode < 0 and b"8 bytes do not lie at a multiple of their size" in done.stderr
    done = launched(tmp_path, "rsqrt.approx.f64 %d0, %d0;", bytes(4 * 32))
    assert done.returncode < 0 and b"rsqrt.approx.f64" in done.stderr and b"cannot translate" in done.stderr


def test_what_nobody_has_translated_is_refused() -> None:
    with pytest.raises(NotImplementedError, match=r"sin\.approx"):
        c_code(HEAD + "sin.approx.f32 %f0, %f0;" + TAIL, [])
    with pytest.raises(NotImplementedError, match="register %q"):
        c_code(HEAD + "mov.u32 %r3, %q;" + TAIL, [])


def test_text_and_warps_are_counted() -> None:
    body = "l_3_cond: match.any.sync.b32 %r4, %r3, -1; red.global.add.u32 [%rd1], %r4; bra l_3_cond;"
    (kernel,) = kernels_of(HEAD + body + TAIL)
    assert PtxCounts.of(kernel) == PtxCounts(instructions=12, loops=1, atomics=1, matches=1)
    assert [warps_of(registers) for registers in (32, 128, 168, 169, 180, 255)] == [64, 16, 12, 8, 8, 8]


def test_without_a_compiler_one_sentence_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    monkeypatch.delenv("EMULATED_CUDA_COMPILER", raising=False)
    monkeypatch.delitem(sys.modules, "drjit", raising=False)
    with pytest.raises(build.BuildError, match=r"^The emulated CUDA device needs a C\+\+ compiler and found none; "):
        build.cxx_compiler()
    if sys.platform.startswith("linux") and os.uname().machine == "x86_64":
        with pytest.raises(build.BuildError, match=r"^The emulated CUDA device needs a C compiler and found none; "):
            build.prepare()


def test_the_device_must_come_before_drjit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "drjit", sys)
    with pytest.raises(build.BuildError, match="prepare the device first"):
        build.prepare()


@pytest.mark.gpu
def test_copies_between_host_and_device_are_counted() -> None:
    if "cuda_emulation.started" not in sys.modules:
        pytest.skip("a GPU's driver does not count")
    import torch
    from cuda_emulation.torch_device import WAITS
    from cuda_emulation.transfers import copies_of

    from difftetvr.backend import get_backend

    here = torch.arange(1000.0)
    there, backend = here.to("cuda"), get_backend("cuda")
    array = backend.floats(there) + 1.0
    target = torch.empty(1000)
    kinds = {
        "PyTorch: arrays to the device": lambda: here.to("cuda"),
        "PyTorch: numbers to the device": lambda: there[torch.tensor([3, 5])],
        "PyTorch: numbers to the host": lambda: there.sum().item(),
        "PyTorch: arrays to the host": lambda: target.copy_(there),
        "Dr.Jit: arrays to the device": lambda: backend.Float(here.numpy()),
        "Dr.Jit: numbers to the host": lambda: backend.run(array) or array[7],
    }
    for kind, call in kinds.items():
        found = copies_of(call)
        assert found.pop(kind) == 1 and all(": bytes to the " in other for other in found), (kind, found)
    assert copies_of(lambda: there[3:9].clone().to("cuda", torch.float64)) == {}
    waited = WAITS.copy()
    there.copy_(here, non_blocking=True)
    here.to("cuda", non_blocking=True)
    assert waited == WAITS
    here.to("cuda")
    assert WAITS - waited == {"copy to the device": 1}
