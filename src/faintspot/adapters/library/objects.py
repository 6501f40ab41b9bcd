"""Machine code of kernels as object files, for processors of any kind and programs without Python.

A kernel gets an entry `int NAME(int64_t *cells)`: each cell is one of its arguments, tuples and arrays taken
apart as Numba does. Numba compiles for one processor in a process, so that each target has its own process,
which calls no kernel.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import platform
import subprocess
import sys
from importlib import import_module
from typing import Any, NamedTuple

import llvmlite.binding as llvm
import numba
from llvmlite import ir
from numba import njit
from numba.core.registry import cpu_target

from faintspot.base.errors import InputError
from faintspot.slopes.kernels.compiling import compile_target, kernel_sources, writable_type
from faintspot.slopes.kernels.groups import driver_of

_SSE = "+sse,+sse2,+cx8,+fxsr,+mmx"
_AVX2 = f"{_SSE},+sse3,+ssse3,+sse4.1,+sse4.2,+popcnt,+avx,+avx2,+fma,+bmi,+bmi2"


class CpuTarget(NamedTuple):
    """Kind of processors that objects are compiled for."""

    level: int
    """As in faintspot.c, which asks the processor for what the level needs; 0: not x86-64."""
    width: int
    """Number of float32 lanes."""
    features: str
    """LLVM's features."""

    @property
    def machine(self) -> str:
        """Kind of processors, as `platform.machine` names it."""
        return "x86_64" if self.level else "aarch64"

    @property
    def needed(self) -> frozenset[str]:
        """Names of the features that not every processor has."""
        return frozenset(name[1:] for name in self.features.split(",")) - {"mmx", "cx8", "fxsr"}


TARGETS = {
    "x86-64-v4": CpuTarget(4, 16, f"{_AVX2},+avx512f,+avx512bw,+avx512cd,+avx512dq,+avx512vl"),
    "x86-64-v3": CpuTarget(3, 8, _AVX2),
    "x86-64": CpuTarget(1, 4, _SSE),
    "aarch64": CpuTarget(0, 4, "+neon,+fp-armv8"),
}
"""Targets by LLVM's name, the fastest first."""


def native_target() -> str:
    """Return the target whose code has the bits of Python's on this processor."""
    features, own = compile_target().features, targets_of(platform.machine())
    return next((name for name in own if TARGETS[name].needed <= features), own[-1])


def targets_of(machine: str) -> tuple[str, ...]:
    """Return the names of the targets of a kind of processors, the fastest first.

    Raises
    ------
    InputError
        When there is none.
    """
    found = tuple(name for name, target in TARGETS.items() if target.machine == machine)
    if not found or platform.system() != "Linux":
        raise InputError(
            f"library: expected Linux on x86-64 or aarch64, got {platform.system()} on {machine}"
        )
    return found


def argument_types(arguments: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return the types for which a kernel is compiled, as `Direct` does."""
    return tuple(writable_type(numba.typeof(argument)) for argument in arguments)


def fingerprint(kernel: Any, kinds: tuple[Any, ...], cpu: str) -> str:
    """Return 16 hexadecimal digits that differ if the machine code of a kernel may differ."""
    digest = hashlib.sha256(f"{numba.__version__} {llvm.llvm_version_info} {cpu} {TARGETS[cpu]}".encode())
    for source in kernel_sources(kernel):
        digest.update(source.read_bytes())
    digest.update(f"{_reference(kernel)} {kinds}".encode())
    return digest.hexdigest()[:16]


def object_file(kernel: Any, kinds: tuple[Any, ...], cpu: str, name: str) -> bytes:
    """Compile a kernel for arguments of these types in a process of its own; return the object file.

    Raises
    ------
    InputError
        When it cannot be compiled.
    """
    environment = {
        **os.environ,
        "NUMBA_CPU_NAME": cpu if TARGETS[cpu].machine == "x86_64" else "generic",
        "NUMBA_CPU_FEATURES": TARGETS[cpu].features,
        "FAINTSPOT_SIMD_WIDTH": str(TARGETS[cpu].width),
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
    }
    program = _FOR_ANOTHER_MACHINE if TARGETS[cpu].machine != platform.machine() else ""
    program = program.format(triple=f"{TARGETS[cpu].machine}-unknown-linux-gnu")
    done = subprocess.run(
        [sys.executable, "-P", "-c", f"{program}from {__name__} import main; main()"],
        input=pickle.dumps((*_reference(kernel), kinds, name)),
        capture_output=True,
        env=environment,
        check=False,
    )
    if done.returncode:
        reason = done.stderr.decode(errors="replace").strip().splitlines() or ["no message"]
        raise InputError(f"kernel for {cpu}: cannot be compiled ({reason[-1]})")
    return done.stdout


_FOR_ANOTHER_MACHINE = """
import llvmlite.binding as llvm
llvm.initialize_all_targets()
llvm.initialize_all_asmprinters()
llvm.get_process_triple = llvm.get_default_triple = lambda: "{triple}"  # before Numba asks
"""


def _reference(kernel: Any) -> tuple[bool, str, str]:
    """Return how another process finds a kernel: whether it is inside a driver, its module and name."""
    own = kernel.py_func.__globals__.get("locate")
    inside = hasattr(own, "py_func") and kernel is driver_of(own)
    function = own.py_func if inside else kernel.py_func
    return inside, function.__module__, function.__qualname__


def main() -> None:
    """Compile the kernel that standard input describes, and write its object file; of the own process."""
    answer = os.dup(1)
    os.dup2(2, 1)
    inside, module, function, kinds, name = pickle.load(sys.stdin.buffer)
    kernel = getattr(import_module(module), function)
    content = _compiled(driver_of(kernel) if inside else kernel, kinds, name)
    with os.fdopen(answer, "wb") as file:
        file.write(content)


def _compiled(kernel: Any, kinds: tuple[Any, ...], name: str) -> bytes:
    """Compile for this process's target; return the object file, in which only `name` can be seen."""
    no_wrappers = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    dispatcher = njit(**{**kernel._options, **no_wrappers})(kernel.py_func)
    dispatcher.compile(kinds)
    module = llvm.parse_assembly(dispatcher.inspect_llvm(kinds))
    module.link_in(llvm.parse_assembly(str(_entry(module, dispatcher.overloads[kinds].fndesc, name))))
    for item in (*module.functions, *module.global_variables):
        if not item.is_declaration:
            item.linkage = llvm.Linkage.external if item.name == name else llvm.Linkage.internal
    module.get_function(name).visibility = llvm.Visibility.hidden
    triple, cpu, features = cpu_target.target_context.codegen().magic_tuple()
    machine = llvm.Target.from_triple(triple).create_target_machine(
        cpu, features, opt=3, reloc="pic", codemodel="default"
    )
    # What nobody can see and nothing uses goes away; the kernel itself is optimised already.
    builder = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=1))
    builder.getModulePassManager().run(module, builder)
    module.verify()
    content: bytes = machine.emit_object(module)
    return content


def _entry(final: Any, descriptor: Any, name: str) -> ir.Module:
    """Return a module with the function that calls a kernel with the arguments in its cells."""
    kind = cpu_target.target_context.call_conv.get_function_type(descriptor.restype, descriptor.argtypes)
    module = ir.Module(name)
    module.triple, module.data_layout = final.triple, final.data_layout
    kernel = ir.Function(module, kind, descriptor.llvm_func_name)
    cell = ir.IntType(64)
    entry = ir.Function(module, ir.FunctionType(ir.IntType(32), [cell.as_pointer()]), name)
    builder = ir.IRBuilder(entry.append_basic_block())
    arguments = [builder.alloca(output.pointee) for output in kind.args[:2]]
    for index, argument in enumerate(kind.args[2:]):
        place = builder.gep(entry.args[0], [cell(index)])
        arguments.append(builder.load(builder.bitcast(place, argument.as_pointer())))
    builder.ret(builder.call(kernel, arguments))
    return module
