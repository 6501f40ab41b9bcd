"""How kernels are compiled: once per machine, kept on disk, anew whenever any kernel's source changes."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from numba import njit
from numba.core import types as numba_types

from faintspot.kernels.cached import kernel_cache


@cache
def _kernels_stamp() -> tuple[tuple[float, int], ...]:
    """Modification time and size of every source file that a kernel may have inlined."""
    package = Path(__file__).parent.parent
    sources = sorted([*package.glob("kernels/*.py"), package / "checks.py", package / "flags.py"])
    return tuple(_stamp(source) for source in sources)


def _stamp(source: Path) -> tuple[float, int]:
    return source.stat().st_mtime, source.stat().st_size


def inlined(function: Callable[..., Any]) -> Any:
    """Make a function part of the machine code of every compiled function that calls it.

    Constant arguments become constants in the machine code, but not to Numba's typing: inlining by Numba
    would type the function's body anew at every call, which takes several times longer to compile.
    """
    return njit(forceinline=True, nogil=True, error_model="numpy", _nrt=False)(function)


def compiled(function: Callable[..., Any]) -> Any:
    """Compile with Numba: cached on disk, without the GIL, division by zero as in NumPy.

    Nor does it count references to arrays: who calls a kernel keeps its arrays alive, and counting them, with
    atomic instructions at every call of one kernel by another, took half of the time of a plain centre of
    gravity. So it cannot make arrays: see `allocating`.
    """
    return _dispatcher(function, _nrt=False)


def compiled_with(function: Callable[..., Any], source: str) -> Any:
    """Compile as `compiled` does a function that calls one of another package, whose source file is given."""
    inside = Path(source).is_relative_to(Path(__file__).parent)
    return _dispatcher(function, () if inside else (Path(source),), _nrt=False)


def allocating(function: Callable[..., Any]) -> Any:
    """Compile as `compiled` does what makes arrays."""
    return _dispatcher(function)


def at_once(function: Callable[..., Any], *kinds: Any) -> Any:
    """Compile now, for arguments of these types alone; return what calls it, in 0.1 us and without any check.

    It keeps the GIL: given up for a moment, it may come back to a real-time thread milliseconds later.
    """
    kernel = _dispatcher(function, nogil=False, _nrt=False)
    kernel.compile(kinds)
    return kernel.overloads[kinds].entry_point


def _dispatcher(
    function: Callable[..., Any], others: tuple[Path, ...] = (), nogil: bool = True, **options: Any
) -> Any:
    """Compile with a cache that asks for all kernels' sources."""
    dispatcher: Any = njit(nogil=nogil, error_model="numpy", **options)(function)
    if hasattr(dispatcher, "_cache"):  # where NUMBA_DISABLE_JIT is set, it is the function itself
        dispatcher._cache = kernel_cache(function, _kernels_stamp() + tuple(_stamp(path) for path in others))
    return dispatcher


class Direct:
    """A kernel for arguments that always have the same types, which are found out once.

    Finding them out takes longer than a small frame's measurement. Nothing is checked afterwards: other types
    would be read as if they were those. Only whether an array may be written to makes no difference, so that
    nothing is compiled once more for arrays that are read-only.
    """

    def __init__(self, kernel: Any) -> None:
        self._kernel = kernel
        self._entry: Any = None

    def __call__(self, *arguments: Any) -> Any:
        """Call the kernel."""
        if self._entry is None:
            signature = tuple(_writable(self._kernel.typeof_pyval(argument)) for argument in arguments)
            self._kernel.compile(signature)
            self._entry = self._kernel.overloads[signature].entry_point
        return self._entry(*arguments)


types: Any = numba_types  # as far as mypy knows, a part of it is missing


def _writable(kind: Any) -> Any:
    """Return the type of arrays that may be written to, also within tuples."""
    if isinstance(kind, types.Array):
        return kind.copy(readonly=False)
    if isinstance(kind, types.BaseNamedTuple):
        return types.NamedTuple([_writable(each) for each in kind], kind.instance_class)
    if isinstance(kind, types.BaseTuple):
        return types.BaseTuple.from_types([_writable(each) for each in kind])
    return kind
