"""How close the denoiser's sweep comes to what the processor's arithmetic units can do.

The bound is the issue bound: the least time in which this processor can issue the vector arithmetic of one
pixel of the sweep, whatever its order. It is measured, not computed from data sheets: the arithmetic
instructions of the sweep's innermost loop are taken from its assembly (as Numba has compiled it for this
machine: the very mnemonics, at the same vector width) and replayed on registers, in a loop of its own that
is assembled as written. Every instruction works on the next of 14 accumulators, so that none waits for its
predecessor; of several orders of the same instructions the fastest is the bound. Bound / sweep is the
fraction of the arithmetic peak for this mix (not of the peak that a loop of multiply-adds alone would have).

What the bound leaves out, so that 1 cannot be reached: loads and stores (two versions of p and the image
are read, one version is written, and three rolling rows are read and written), latencies, the loop's own
instructions, the first and last row and column. The state of 16 images (82 kB) exceeds most first-level
caches. To tell whether memory is what keeps the sweep from its bound, as many loads and stores of whole
vectors as in the loop are replayed too, the state streaming by in a buffer of the same size and the rows at
a fixed place in the first-level cache: alone ("memory ns"), and among the arithmetic ("both ns"), still
without long chains of instructions that wait for each other. Between "both" and the sweep lie latencies and
the loop's own instructions.

The fraction is that of the best times. (Others on the same physical core slow the sweep, which needs many
instructions in flight, by up to 1.5, but hardly the bound; the median of the ratios shows how much.)

Everything is run in turns on one processor; the clock is measured in the same turns from a chain of
dependent integer additions, one cycle each. x86-64 only: the replay is written in its assembly.
"""

import ctypes
import platform
import random
import re
from collections import Counter
from collections.abc import Callable
from typing import Any

import llvmlite.binding as llvm
import numpy as np

from benchmarks.frames.sweeps import SIDE, Group, numba_sweeps
from benchmarks.measuring import Candidate, Row, Table, Times, best, interleaved, median_ratio, pinned, spread
from faintspot.slopes.kernels.compiling import compile_target
from faintspot.slopes.kernels.host import aligned_zeros
from faintspot.slopes.kernels.total_variation.sweeps import STATE_VECTORS

WIDTHS = (16, 8, 4)
TARGET = 0.85
ACCUMULATORS = (
    14  # more than latency x issue width of any processor so far; 16 registers exist without AVX-512
)
STATE_STORES = 2  # px and py
REPEATS = 1000  # of a block in one call
SWEEPS = 100
CHAIN = 400  # additions in the block that measures the clock

_REGISTER = {16: "zmm", 8: "ymm", 4: "xmm"}
_ARITHMETIC = re.compile(r"v(add|sub|mul|div|max|min|sqrt|rsqrt|rsqrt14|rcp|rcp14|fn?m(add|sub)\d+)ps$")
_ONE_OPERAND = re.compile(r"v(r?sqrt|rcp)")


# The sweep's innermost loop ----------------------------------------------------------------------------


def _innermost_loops(lines: list[str]) -> list[list[str]]:
    """Return the bodies of the loops that contain no other loop."""
    labels = {line[:-1]: i for i, line in enumerate(lines) if re.match(r"\.?L\w+:$", line)}
    loops = []
    for i, line in enumerate(lines):
        jump = re.match(r"j\w+\s+(\.?L\w+)$", line)
        if jump and labels.get(jump[1], i) < i:
            loops.append((labels[jump[1]], i))
    return [
        lines[start : stop + 1]
        for start, stop in loops
        if not any(start <= a and b <= stop and (a, b) != (start, stop) for a, b in loops)
    ]


def sweep_loop(width: int) -> list[str]:
    """Return the assembly of the loop over the pixels of inner rows: the one with the most arithmetic."""
    Group(width).numba(1)
    assembly = next(text for types, text in numba_sweeps.inspect_asm().items() if types[0].width == width)
    lines = [" ".join(line.split("#")[0].split()) for line in assembly.splitlines()]
    loops = [loop for loop in _innermost_loops(lines) if _pixels(loop)]
    return max(loops, key=lambda loop: len(arithmetic(loop)))


def _pixels(loop: list[str]) -> int:
    """Return the pixels in one turn of the loop: every pixel has one reciprocal square root."""
    return sum(line.startswith("vrsqrt") for line in loop)


def arithmetic(loop: list[str]) -> list[str]:
    """Return the mnemonics of the vector arithmetic, in order."""
    return [line.split()[0] for line in loop if line and _ARITHMETIC.match(line.split()[0])]


def loads_and_stores(loop: list[str]) -> tuple[int, int]:
    """Count the vector instructions that read memory, and those that write it."""
    vector = [line for line in loop if line.startswith("v") and "(" in line]
    stores = sum(line.endswith(")") for line in vector)
    return len(vector) - stores, stores


# Replay ------------------------------------------------------------------------------------------------


_engines: list[Any] = []  # keep the machine code alive


def assemble(block: list[str], width: int) -> Callable[[int, int], None]:
    """Return a function of (repeats, address) that runs a block of instructions again and again.

    Vector register 15 holds ones, so do the accumulators at first; %rsi is the address, %rax and %rdx are
    the block's to use.
    """
    ones = [f"vbroadcastss %xmm15, %{_REGISTER[width]}{i}" for i in range(ACCUMULATORS)]
    if width == 4:
        ones = [line.replace("vbroadcastss", "vshufps $0, %xmm15,") for line in ones]
    start = ["mov $0x3f800000, %eax", "vmovd %eax, %xmm15", *ones]
    start += [f"vmovaps %{_REGISTER[width]}0, %{_REGISTER[width]}15", "mov %rdi, %rcx"]
    text = "\\0A".join([*start, ".p2align 5", "1:", *block, "dec %rcx", "jne 1b", "vzeroupper"])
    text = text.replace("$", "$$")
    clobbers = "~{rax},~{rcx},~{rdx},~{memory},~{flags}"
    code = f'call void asm sideeffect "{text}", "{{rdi}},{{rsi}},{clobbers}"(i64 %n, i64 %address)'
    llvm.initialize_native_asmparser()
    module = llvm.parse_assembly(f"define void @replay(i64 %n, i64 %address) {{\n {code}\n ret void\n}}")
    machine = llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten()
    )
    engine = llvm.create_mcjit_compiler(module, machine)
    engine.finalize_object()
    _engines.append(engine)
    function = ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_int64)(engine.get_function_address("replay"))
    return lambda repeats, address: function(repeats, address)


def copies(mnemonics: list[str]) -> int:
    """Return how often the instructions stand in a block: so long that its loop costs next to nothing."""
    return ACCUMULATORS * max(1, 20 // len(mnemonics))


def _arithmetic_block(mnemonics: list[str], width: int) -> list[str]:
    """Return these instructions, each on the next accumulator."""
    register, block = _REGISTER[width], []
    for i, mnemonic in enumerate(mnemonics):
        accumulator = f"%{register}{i % ACCUMULATORS}"
        middle = "" if _ONE_OPERAND.match(mnemonic) else f" {accumulator},"
        block.append(f"{mnemonic} %{register}15,{middle} {accumulator}")
    return block


def on_registers(mnemonics: list[str], width: int) -> Candidate:
    """Return a run of REPEATS blocks of `copies` of these instructions."""
    run = assemble(_arithmetic_block(mnemonics * copies(mnemonics), width), width)
    return lambda: run(REPEATS, 0)


def with_memory(mnemonics: list[str], loads: int, stores: int, width: int, pixels: int) -> Candidate:
    """Return a run of SWEEPS passes over the state, with these loads, stores and instructions in a turn."""
    size, register = 4 * width, _REGISTER[width]
    turn, turns = STATE_VECTORS * size * pixels, SIDE**2 // pixels
    rows = turn * turns  # the rolling rows' stand-in, after the state
    memory = aligned_zeros((rows + (loads + stores) * size) // 4, np.float32)

    def target(i: int) -> str:
        return f"%{register}{i % ACCUMULATORS}"

    streamed, written = STATE_VECTORS * pixels, STATE_STORES * pixels
    block = [f"vmovups {i * size}(%rdx), {target(i)}" for i in range(streamed)]
    block += [f"vmovups {rows + i * size}(%rsi), {target(i)}" for i in range(loads - streamed)]
    block += [f"vmovups {target(i)}, {i * size}(%rdx)" for i in range(written)]
    block += [f"vmovups {target(i)}, {rows + (loads + i) * size}(%rsi)" for i in range(stores - written)]
    # Dealt evenly among the arithmetic.
    places = [(i + 0.5) / len(block) for i in range(len(block))]
    places += [(i + 0.5) / max(1, len(mnemonics)) for i in range(len(mnemonics))]
    lines = block + _arithmetic_block(mnemonics, width)
    mixed = [line for _, line in sorted(zip(places, lines, strict=True))]
    one_pass = ["mov %rsi, %rdx", f"mov ${turns}, %eax", "2:", *mixed]
    run = assemble([*one_pass, f"add ${turn}, %rdx", "dec %eax", "jne 2b"], width)
    return lambda: run(SWEEPS, memory.ctypes.data)


def clock() -> Candidate:
    """Return a run of REPEATS times CHAIN additions that wait for each other: one cycle each."""
    run = assemble(["add %rdi, %rax"] * CHAIN, 4)
    return lambda: run(REPEATS, 0)


# Measurements ------------------------------------------------------------------------------------------


def kernel_root(loop: list[str]) -> list[str]:
    """Return the instructions of a reciprocal square root as compiled: the estimate and one Newton step."""
    estimate = next(name for name in arithmetic(loop) if name.startswith("vrsqrt"))
    return [estimate, "vmulps", "vfmadd213ps", "vmulps", "vmulps"]


def _throughput(width: int, loop: list[str]) -> Row:
    """Measure single instructions."""
    mixes = {
        "add": ["vaddps"],
        "multiply": ["vmulps"],
        "multiply-add": ["vfmadd213ps"],
        "max": ["vmaxps"],
        "root estimate": kernel_root(loop)[:1],
        "root": kernel_root(loop),
        "add & multiply-add": ["vaddps", "vfmadd213ps"],
    }
    candidates = {name: on_registers(mix, width) for name, mix in mixes.items()} | {"clock": clock()}
    times = interleaved(candidates, seconds=2.0)
    cycle = best(times, "clock") / (REPEATS * CHAIN)
    cycles = {name: best(times, name) / (REPEATS * copies(mix) * cycle) for name, mix in mixes.items()}
    return Row(f"W = {width}", {"GHz": 1e-9 / cycle} | cycles)


def _orders(mnemonics: list[str]) -> dict[str, list[str]]:
    """Return the same instructions in several orders."""
    orders = {"as compiled": mnemonics, "sorted": sorted(mnemonics)}
    for seed in range(4):
        orders[f"shuffled {seed}"] = random.Random(seed).sample(mnemonics, len(mnemonics))
    return orders


def _fraction(width: int, loop: list[str]) -> Row:
    """Measure the sweep, its bound, and its memory traffic."""
    mnemonics, pixels = arithmetic(loop), _pixels(loop)
    loads, stores = loads_and_stores(loop)
    orders = _orders(mnemonics)
    group = Group(width)
    candidates: dict[str, Candidate] = {"sweep": lambda: group.numba(SWEEPS)}
    candidates |= {name: on_registers(order, width) for name, order in orders.items()}
    candidates["memory"] = with_memory([], loads, stores, width, pixels)
    candidates["both"] = with_memory(mnemonics, loads, stores, width, pixels)
    candidates["clock"] = clock()
    times = interleaved(candidates, seconds=4.0)
    # To seconds per pixel of all W images.
    times["sweep"] /= SWEEPS * SIDE**2
    times["memory"] /= SWEEPS * SIDE**2
    times["both"] /= SWEEPS * SIDE**2
    for name in orders:
        times[name] /= REPEATS * copies(mnemonics) * pixels
    bound = min(orders, key=lambda name: best(times, name))
    return _fraction_row(width, times, bound, mnemonics, pixels)


def _fraction_row(width: int, times: Times, bound: str, mnemonics: list[str], pixels: int) -> Row:
    cycle = best(times, "clock") / (REPEATS * CHAIN)
    fraction = best(times, bound) / best(times, "sweep")
    values = {
        "arithmetic": len(mnemonics) / pixels,
        "sweep ns": best(times, "sweep") * 1e9,
        "bound ns": best(times, bound) * 1e9,
        "memory ns": best(times, "memory") * 1e9,
        "both ns": best(times, "both") * 1e9,
        "sweep cycles": best(times, "sweep") / cycle,
        "bound cycles": best(times, bound) / cycle,
        "median": median_ratio(times, bound, "sweep"),
        "fraction": fraction,
    }
    sure = spread(times, lambda part: best(part, bound) / best(part, "sweep"))
    return Row(
        f"W = {width}", values, f">= {TARGET}", fraction >= TARGET, {"fraction": sure}, better="higher"
    )


def run() -> list[Table]:
    """Measure for every vector width of the processor that Numba compiles for."""
    title = "The sweep against the arithmetic issue bound, per pixel of W images"
    if platform.machine() not in ("x86_64", "AMD64"):
        return [Table("roofline", title, [], ["x86-64 only"])]
    features = compile_target().features
    has = {16: "avx512f" in features, 8: "avx2" in features, 4: "avx" in features}
    instructions, fractions, notes = [], [], []
    with pinned():
        for width in (w for w in WIDTHS if has[w]):
            loop = sweep_loop(width)
            instructions.append(_throughput(width, loop))
            fractions.append(_fraction(width, loop))
            counts = ", ".join(f"{count} {name}" for name, count in Counter(arithmetic(loop)).most_common())
            loads, stores = loads_and_stores(loop)
            notes.append(
                f"W = {width}: {_pixels(loop)} pixel(s) a turn: {counts}; {loads} loads, {stores} stores"
            )
    notes.append(
        "fraction: best bound / best sweep; median: of their ratios in a turn; memory, both: see roofline.py"
    )
    return [
        Table(
            "roofline_instructions",
            "Cycles per vector instruction, registers only",
            instructions,
            ["root: estimate and Newton step, five instructions; add & multiply-add: both"],
        ),
        Table("roofline", title, fractions, notes),
    ]
