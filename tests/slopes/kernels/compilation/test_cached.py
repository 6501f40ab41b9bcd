"""A cache that cannot be written or read ends nothing, and says so once."""

import warnings
from pathlib import Path
from typing import Any

import numba
import pytest
from numba.core.caching import CacheImpl

from faintspot.base.errors import CacheWarning
from faintspot.slopes.kernels.compilation import compiling
from faintspot.slopes.kernels.compilation.compiling import kernel_cache


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


def test_kept_for_each_kind_of_argument_in_a_file_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
def test_damaged_files_are_compiled_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: str
) -> None:
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
    caplog.set_level("INFO", "faintspot.slopes.kernels.compilation.compiling")
    compiled = dispatcher(tmp_path, monkeypatch)
    assert (compiled(1), compiled(1.5)) == (2, 2.5)
    assert [record.getMessage().split()[0] for record in caplog.records] == ["compiling"]
    compiling._tell_once.cache_clear()
    assert dispatcher(tmp_path, monkeypatch)(1) == 2
    assert len(caplog.records) == 1
