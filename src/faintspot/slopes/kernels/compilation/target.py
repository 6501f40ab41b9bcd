"""The processor that Numba compiles for: this machine's, unless NUMBA_CPU_NAME or NUMBA_CPU_FEATURES are set.

On clusters whose nodes share a cache folder, NUMBA_CPU_NAME=generic makes code that runs on all of them.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple


class Target(NamedTuple):
    """Target of the machine code."""

    triple: str
    """Such as x86_64-unknown-linux-gnu."""
    cpu: str
    """LLVM's name of the processor; "generic" is the least of its kind."""
    features: frozenset[str]
    """LLVM's names of the features that may be used, beyond those that every processor of the kind has."""


@cache
def compile_target() -> Target:
    """Return Numba's target, not the machine's: LLVM aborts if code uses a feature that the target lacks."""
    from numba.core.registry import cpu_target

    triple, cpu, features = cpu_target.target_context.codegen().magic_tuple()
    names = (name.strip() for name in features.split(","))
    return Target(triple, cpu, frozenset(name[1:] for name in names if name.startswith("+")))


def vector_registers() -> int:
    """Return the number of vector registers of the target: 32 with AVX-512 and on aarch64, else 16."""
    target = compile_target()
    return 32 if "avx512vl" in target.features or target.triple.startswith("aarch64") else 16
