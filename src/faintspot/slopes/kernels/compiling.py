"""Compilation of kernels: once per machine, cached on disk, and repeated when a kernel source changes.

Numba makes machine code of every function, and optimises it anew with every function that calls it, which
took half of the time of compiling a pipeline. Here a kernel is optimised and becomes machine code once, where
Python calls it, together with all that it calls; what other kernels call is only a part of them.
"""

import hashlib
import logging
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import cache, cached_property
from pathlib import Path
from typing import Any, NamedTuple

from numba import config, njit
from numba.core import types as numba_types
from numba.core.caching import FunctionCache, IndexDataCacheFile, NullCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.registry import CPUDispatcher

from faintspot.base import checks
from faintspot.base.errors import CacheWarning


def kernel_cache(function: Callable[..., Any], stamp: Any) -> Any:
    """Return the cache of a function's machine code, valid as long as `stamp` is the same.

    Numba's own cache asks only whether the function's own file has changed, but kernels inline each other
    across files.
    """
    try:
        return _KernelCache(function, stamp)
    except RuntimeError:  # neither in NUMBA_CACHE_DIR, nor beside the sources, nor in the user's folder
        _warn_once("no folder for them can be written")
        return NullCache()


class _KernelCache(FunctionCache):
    """Numba's cache, tolerant of a disk that is full, read-only or damaged.

    Of several processes that need the same code, one compiles it while the others wait.
    """

    _lock: Any = None

    def __init__(self, function: Callable[..., Any], stamp: Any) -> None:
        super().__init__(function)
        self._cache_file = _KernelFiles(self._cache_path, self._impl.filename_base, stamp)

    def load_overload(self, *arguments: Any) -> Any:
        """Return the cached code, or None, and keep others from compiling it, until it is saved."""
        self._unlock()  # after a compilation that failed
        kept = self._kept(*arguments)
        if kept is None:
            self._lock = _locked(Path(self._cache_path, f"{self._impl.filename_base}.lock"))
            kept = self._kept(*arguments)
            if kept is None:
                _tell_once()
            else:
                self._unlock()
        return kept

    def _kept(self, *arguments: Any) -> Any:
        """Return the cached code, or discard it and return None if it cannot be read."""
        try:
            return super().load_overload(*arguments)
        except Exception:  # a damaged pickle raises anything
            with suppress(OSError):
                self._cache_file.flush()
        return None

    def save_overload(self, *arguments: Any) -> None:
        """Store machine code if possible."""
        try:
            super().save_overload(*arguments)
        except OSError as error:
            _warn_once(f"{self._cache_path}: {error.strerror or error}")
        self._unlock()

    def _unlock(self) -> None:
        if self._lock is not None:
            self._lock.release()
        self._lock = None


def _locked(path: Path) -> Any:
    """Return a lock on a file; None where there are none, or another process takes too long."""
    with suppress(ImportError, NotImplementedError, OSError):  # a time that is up is an OSError, too
        from filelock import FileLock  # of an extra

        lock = FileLock(path, timeout=_MOST_WAITING_S)
        lock.acquire()
        return lock
    return None


class _KernelFiles(IndexDataCacheFile):
    """The files of one function: an index, and one for each kind of arguments and processor.

    Numba counts the latter from 1. Where two processes compile at once, both may then write the same file,
    and the index name it as the code for one processor when it is that for another. Here names say what is
    inside.
    """

    def save(self, key: Any, data: Any) -> None:
        """Keep machine code; of two processes that do so at once, one may have to compile again later."""
        name = f"{self._index_name}.{hashlib.sha256(repr(key).encode()).hexdigest()[:24]}.nbc"
        self._save_data(name, data)
        self._save_index({**self._load_index(), key: name})


@cache
def _tell_once() -> None:
    """Log that this run takes longer because kernels are compiled."""
    logging.getLogger(__name__).info("compiling what this machine has not used yet; later runs start at once")


@cache
def _warn_once(reason: str) -> None:
    warnings.warn(
        f"compiled kernels cannot be kept ({reason}): every process compiles them anew, which takes "
        "seconds each time; set NUMBA_CACHE_DIR to a folder that can be written",
        CacheWarning,
        stacklevel=2,
    )


_KERNELS = Path(__file__).parent
_MOST_WAITING_S = 60.0  # for another process that compiles


@cache
def _kernels_stamp() -> tuple[tuple[float, int], ...]:
    """Return modification time and size of every source file that a kernel may inline."""
    return tuple(_stamp(source) for source in kernel_sources())


def kernel_sources(kernel: Any = None) -> list[Path]:
    """Return every source file that kernels may inline, and those that this one depends on besides."""
    base = Path(checks.__file__).parent
    own = () if kernel is None else kernel._sources
    return sorted([*_KERNELS.rglob("*.py"), base / "checks.py", base / "flags.py", *own])


def _stamp(source: Path) -> tuple[float, int]:
    return source.stat().st_mtime, source.stat().st_size


def inlined(function: Callable[..., Any]) -> Any:
    """Make a function part of the machine code of every compiled function that calls it.

    Constant arguments become constants in the machine code, but not to Numba's typing: inlining by Numba
    would type the function's body anew at every call, which takes several times longer to compile.
    """
    return _kernel(function, forceinline=True)


def compiled(function: Callable[..., Any]) -> Any:
    """Compile with Numba: cached on disk, without the GIL, division by zero as in NumPy.

    Nor does it count references to arrays: who calls a kernel keeps its arrays alive, and counting them, with
    atomic instructions at every call of one kernel by another, took half of the time of a plain centre of
    gravity. So it cannot make arrays.
    """
    return _kernel(function)


def compiled_with(function: Callable[..., Any], source: str) -> Any:
    """Compile like `compiled` a function that calls one of another package, whose source file is given."""
    inside = Path(source).is_relative_to(_KERNELS)
    return _kernel(function, () if inside else (Path(source),))


def at_once(function: Callable[..., Any], *kinds: Any) -> Any:
    """Compile now for the given argument types; return a function that calls it in 0.1 us without checks.

    It keeps the GIL: given up for a moment, it may come back to a real-time thread milliseconds later.
    """
    whole = _kernel(function, nogil=False).whole
    whole.compile(kinds)
    return whole.overloads[kinds].entry_point


def _kernel(function: Callable[..., Any], sources: tuple[Path, ...] = (), **options: Any) -> Any:
    """Return the kernel of a function; `sources` are other files that its code depends on."""
    return function if config.DISABLE_JIT else _Kernel(function, sources, options)


class _Kernel(CPUDispatcher):
    """Function that kernels call; for calls from Python it is compiled again as a whole, and cached."""

    def __init__(
        self, function: Callable[..., Any], sources: tuple[Path, ...], options: dict[str, Any]
    ) -> None:
        self._sources = sources
        self._options = {"nogil": True, "error_model": "numpy", "_nrt": False, **options}
        wrappers = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
        every = {"nopython": True, "boundscheck": None, **self._options, **wrappers}
        super().__init__(function, targetoptions=every, pipeline_class=_PartCompiler)

    @cached_property
    def whole(self) -> Any:
        """Compiled function for calls from Python, with its machine code cached on disk."""
        dispatcher: Any = njit(**self._options)(self.py_func)
        stamps = tuple(_stamp(path) for path in self._sources)
        dispatcher._cache = kernel_cache(self.py_func, _kernels_stamp() + stamps)
        return dispatcher

    def get_call_template(self, arguments: Any, named: Any) -> Any:
        """Return what a call of these types is: what is written out is of the same type as any other value.

        Else the same code would be compiled for every number that it is called with somewhere.
        """
        return super().get_call_template(tuple(map(types.unliteral, arguments)), named)

    def add_overload(self, result: Any) -> None:
        """Keep what kernels call; there is nothing that Python's call could find."""
        self.overloads[tuple(result.signature.args)] = result

    def __call__(self, *arguments: Any) -> Any:
        """Call from Python."""
        return self.whole(*arguments)


class _PartCompiler(Compiler):
    """Stop before optimisation and machine code, which come with the kernel that this is a part of."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        context = self.state.targetctx  # a copy, made for this compilation
        context.get_executable = lambda library, description, environment: object()  # a name for callers
        self.state.library = _PartLibrary(context.codegen(), "part")


class _PartLibrary(JITCodeLibrary):
    """LLVM's code of a part, as it was generated."""

    def _optimize_functions(self, module: Any) -> None:
        module.data_layout = self._codegen._data_layout

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalized = True


class Direct:
    """A kernel for arguments that always have the same types, which are found out once.

    Finding them out takes longer than a small frame's measurement. Nothing is checked afterwards: other types
    would be read as if they were those. Only whether an array may be written to makes no difference, so that
    nothing is compiled once more for arrays that are read-only.
    """

    def __init__(self, kernel: Any) -> None:
        self._kernel = kernel.whole
        self._entry: Any = None

    def __call__(self, *arguments: Any) -> Any:
        """Call the kernel."""
        if self._entry is None:
            self._entry = self._compiled(arguments).entry_point
        return self._entry(*arguments)

    def address(self, *arguments: Any) -> int:
        """Return the address of the kernel's machine code, for kernels that call it with such arguments."""
        result = self._compiled(arguments)
        address: int = result.library.get_pointer_to_function(result.fndesc.llvm_func_name)
        return address

    def _compiled(self, arguments: tuple[Any, ...]) -> Any:
        signature = tuple(writable_type(self._kernel.typeof_pyval(argument)) for argument in arguments)
        self._kernel.compile(signature)
        return self._kernel.overloads[signature]


types: Any = numba_types  # as far as mypy knows, a part of it is missing


def writable_type(kind: Any) -> Any:
    """Return the type with arrays that may be written to, also within tuples."""
    if isinstance(kind, types.Array):
        return kind.copy(readonly=False)
    if isinstance(kind, types.BaseNamedTuple):
        return types.NamedTuple([writable_type(each) for each in kind], kind.instance_class)
    if isinstance(kind, types.BaseTuple):
        return types.BaseTuple.from_types([writable_type(each) for each in kind])
    return kind


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
