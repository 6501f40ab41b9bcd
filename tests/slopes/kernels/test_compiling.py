"""What Python calls becomes machine code with all that it calls; what kernels call does not alone."""

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from numba.core.caching import CacheImpl, NullCache

from faintspot.base.errors import CacheWarning
from faintspot.slopes.kernels import compiling
from faintspot.slopes.kernels.compiling import (
    Direct,
    compile_target,
    compiled,
    inlined,
    kernel_cache,
)

pytestmark = [pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")]


@inlined
def twice(value: Any) -> Any:
    return value + value


@compiled
def total_twice(values: Any) -> Any:
    total = 0.0
    for value in values:
        total += twice(value)
    return total


@compiled
def with_next(values: Any, following: Any) -> Any:
    return total_twice(values) + total_twice(following)


@compiled
def with_sign(number: Any, upwards: Any) -> Any:
    return number if upwards else -number


@compiled
def with_both(values: Any, more: Any) -> Any:
    return total_twice(values) + 0.5 * total_twice(more)


@compiled
def total_of(values: Any, more: Any) -> Any:
    if more is not None:
        return with_both(values, more)
    return 0.0


VALUES = np.arange(5.0)


@pytest.fixture(autouse=True, scope="module")
def _nothing_kept() -> Iterator[None]:
    """What comes from disk as a whole has no parts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiling, "kernel_cache", lambda *arguments: NullCache())
        yield


def test_a_part_has_neither_machine_code_nor_an_entry_from_python() -> None:
    assert with_next(VALUES, VALUES) == 40.0
    (part,) = total_twice.overloads.values()
    assert not part.library.get_pointer_to_function(part.fndesc.llvm_func_name)
    (whole,) = with_next.whole.overloads.values()
    assert whole.library.get_pointer_to_function(whole.fndesc.llvm_func_name)


def test_what_is_a_part_can_be_called_from_python_as_well() -> None:
    assert with_next(VALUES, VALUES) == 40.0
    assert total_twice(VALUES) == 20.0
    assert twice(1.5) == 3.0


def test_a_part_is_compiled_once_for_all_who_call_it() -> None:
    for array in (VALUES, VALUES.astype(np.float32)):
        assert with_next(array, VALUES) == with_next(VALUES, array) == 40.0
    assert len(total_twice.overloads) == 2


def test_other_compiled_functions_may_call_parts_and_parts_them() -> None:
    @numba.njit
    def outside(values: Any) -> Any:
        return total_twice(values) + 1.0

    @compiled
    def inside(values: Any) -> Any:
        return outside(values) + 1.0

    assert outside(VALUES) == 21.0
    assert inside(VALUES) == 22.0


def test_read_only_arrays_do_not_compile_anew_where_types_are_found_once() -> None:
    direct = Direct(total_twice)
    frozen = VALUES.copy()
    frozen.flags.writeable = False
    assert direct(frozen) == direct(VALUES) == 20.0


def test_a_part_is_not_compiled_anew_for_what_is_written_out() -> None:
    @compiled
    def three(offset: Any, upwards: Any) -> Any:
        return with_sign(1, True) + with_sign(offset, upwards) + with_sign(2, False)

    assert three(4, True) == 3
    assert len(with_sign.overloads) == 1


def test_of_what_is_none_nothing_is_compiled() -> None:
    @compiled
    def without(values: Any) -> Any:
        return total_of(values, None)

    @compiled
    def twofold(values: Any) -> Any:
        return total_of(values, values)

    assert without(VALUES) == 0.0
    assert not with_both.overloads
    assert twofold(VALUES) == 30.0
    assert with_both.overloads


@pytest.fixture(autouse=True)
def _nothing_said_yet() -> None:
    compiling._warn_once.cache_clear()
    compiling._tell_once.cache_clear()


def plus_one(number: Any) -> Any:
    return number + 1


def dispatcher(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a new compiled function with its cache in a folder."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(folder))
    made: Any = numba.njit(plus_one)
    made._cache = kernel_cache(plus_one, "stamp")
    return made


def hits(compiled: Any) -> int:
    return sum(compiled.stats.cache_hits.values())


def test_each_kind_of_argument_has_a_file_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = dispatcher(tmp_path, monkeypatch), dispatcher(tmp_path, monkeypatch)
    # As two processes do: both have read the index before either writes it.
    monkeypatch.setattr(first._cache._cache_file, "_load_index", dict)
    monkeypatch.setattr(second._cache._cache_file, "_load_index", dict)
    assert first(1) == 2
    assert second(1.5) == 2.5
    assert len(list(tmp_path.rglob("*.nbc"))) == 2
    third = dispatcher(tmp_path, monkeypatch)
    assert (third(1), third(1.5)) == (2, 2.5)
    assert hits(third) == 1  # the index is that of the last one
    fourth = dispatcher(tmp_path, monkeypatch)
    assert (fourth(1), fourth(1.5)) == (2, 2.5)
    assert hits(fourth) == 2


def test_one_process_compiles_while_others_wait(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    filelock = pytest.importorskip("filelock")
    first = dispatcher(tmp_path, monkeypatch)
    assert first(1) == 2
    (path,) = tmp_path.rglob("*.lock")
    with filelock.FileLock(path, timeout=0):  # it is free again
        assert dispatcher(tmp_path, monkeypatch)(1) == 2  # what is there needs no lock
        monkeypatch.setattr(compiling, "_MOST_WAITING_S", 0.01)
        assert first(1.5) == 2.5  # after waiting
    assert first._cache.load_overload((numba.types.complex128,), first.targetctx) is None
    with pytest.raises(filelock.Timeout):  # it is about to be compiled
        filelock.FileLock(path, timeout=0).acquire()
    assert first(1j) == 1 + 1j
    filelock.FileLock(path, timeout=0).acquire()


def test_no_folder_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CacheImpl, "_locator_classes", [])
    with pytest.warns(CacheWarning, match="NUMBA_CACHE_DIR") as said:
        compiled = dispatcher(tmp_path, monkeypatch)
    dispatcher(tmp_path, monkeypatch)  # says it no more: a warning is an error
    assert "\n" not in str(said[0].message)
    assert compiled(1) == 2


def test_a_folder_that_goes_away(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compiled = dispatcher(tmp_path / "cache", monkeypatch)
    (tmp_path / "cache").rename(tmp_path / "former")
    (tmp_path / "cache").write_text("a file now")
    with pytest.warns(CacheWarning, match=r"cache.*NUMBA_CACHE_DIR") as said:
        assert compiled(1) == 2
    assert compiled(1.5) == 2.5  # says it no more: a warning is an error
    assert len(said) == 1


@pytest.mark.parametrize("ending", ["nbi", "nbc"])
def test_damaged_files_are_made_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: str) -> None:
    assert dispatcher(tmp_path, monkeypatch)(1) == 2
    (damaged,) = tmp_path.rglob(f"*.{ending}")
    damaged.write_bytes(b"\x80\x04garbage")
    with warnings.catch_warnings():
        warnings.simplefilter("error", CacheWarning)
        again = dispatcher(tmp_path, monkeypatch)
        assert again(1) == 2
    assert hits(again) == 0
    mended = dispatcher(tmp_path, monkeypatch)
    assert mended(1) == 2
    assert hits(mended) == 1


def test_says_once_that_it_compiles(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "faintspot.slopes.kernels.compiling")
    compiled = dispatcher(tmp_path, monkeypatch)
    assert (compiled(1), compiled(1.5)) == (2, 2.5)
    assert [record.getMessage().split()[0] for record in caplog.records] == ["compiling"]
    compiling._tell_once.cache_clear()
    assert dispatcher(tmp_path, monkeypatch)(1) == 2
    assert len(caplog.records) == 1


def test_target_of_this_process() -> None:
    target = compile_target()
    assert target.triple.count("-") >= 2
    assert target.cpu
    assert all(name and name[0] not in "+-" for name in target.features)
