"""Results of finished units of work: in a dictionary, or in a Zarr store (format 3) with one chunk a unit.

In a store, all variables of a unit are written first, then that it is done. However the program ends, a unit
that is done is whole; the others are worked on again.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from faintspot.base import __version__
from faintspot.base.errors import InputError, load_package
from faintspot.base.files import output_errors
from faintspot.io.stored_array import one_line
from faintspot.io.zarr_store import new_store, stored_attributes

if TYPE_CHECKING:
    import xarray


Arrays = Mapping[str, NDArray[Any]]

FORMAT = 2
DONE = "done"
_FORMAT, _KIND, _FINGERPRINT, _UNITS = "format", "kind", "fingerprint", "units"
OWN_ATTRIBUTES = (_FORMAT, _KIND, _UNITS)
"""Attributes that a store adds to those that it is given."""


def fingerprint_of(*identity: str) -> str:
    """Return a text that differs whenever these texts, the version or the format of the results do."""
    text = "\n".join([str(FORMAT), __version__, *identity])
    return hashlib.sha256(text.encode()).hexdigest()[:32]


class UnitStore(Protocol):
    """Results of finished units by key: a dictionary, or a `ZarrStore`."""

    def __contains__(self, key: object, /) -> bool: ...
    def __getitem__(self, key: str, /) -> Arrays: ...
    def __setitem__(self, key: str, result: Arrays, /) -> None: ...


class ZarrStore:
    """Results of units that have the same variables, in a Zarr store that is created or continued.

    Parameters
    ----------
    path : path
        The store, a folder.
    kind : str
        What the units are, in a word or two such as "study".
    fingerprint : str
        Of everything that results depend on, see `fingerprint_of`.
    units : sequence of str
        Keys of the units. Those that are in the store already stay in it.
    attributes : mapping, optional
        What else is noted in the store.
    template : xarray.Dataset, optional
        All variables, filled with what stands for "not there", and coordinates; the first axis is that of the
        units. Without one, variables have the shapes of the first result that is written.
    overwrite : bool
        Begin anew, whichever store of this kind is there.

    Raises
    ------
    InputError
        When there is something else than a store of this experiment, or it cannot be written.
    MissingExtraError
        When zarr is not installed.
    """

    def __init__(
        self,
        path: str | Path,
        kind: str,
        fingerprint: str,
        units: Sequence[str],
        *,
        attributes: Mapping[str, object] | None = None,
        template: xarray.Dataset | None = None,
        overwrite: bool = False,
    ) -> None:
        self.path = Path(path)
        own = {**(attributes or {}), _FORMAT: FORMAT, _KIND: kind, _FINGERPRINT: fingerprint}
        _check_path(self.path, own, overwrite=overwrite)
        zarr = load_package("zarr")
        with output_errors(self.path):
            if overwrite and self.path.exists():
                shutil.rmtree(self.path)
            if not self.path.exists():
                _create(self.path, {**own, _UNITS: list(units)}, template)
            for remains in self.path.rglob("*.partial"):  # of a program that was killed while it wrote
                remains.unlink(missing_ok=True)
        try:
            self._group: Any = zarr.open_group(str(self.path), mode="r+")
            self._arrays: dict[str, Any] = dict(self._group.arrays())
            stored = list(self._group.attrs[_UNITS])
            self._rows = {key: row for row, key in enumerate(dict.fromkeys([*stored, *units]))}
            self._done = {stored[row] for row in np.flatnonzero(self._arrays[DONE][: len(stored)])}
        except Exception as error:  # broken metadata makes zarr raise many things
            raise InputError(
                f"{self.path}: damaged, it cannot be resumed: delete it ({one_line(error)})"
            ) from None
        if len(self._rows) > len(stored):
            self._lengthen()

    def __contains__(self, key: object) -> bool:
        return key in self._done

    def __setitem__(self, key: str, result: Arrays) -> None:
        """Keep the result of a unit: each variable is one chunk; then it is noted that the unit is done."""
        row = self._rows[key]
        with output_errors(self.path):
            for name, values in result.items():
                values = np.asarray(values)
                if name not in self._arrays:
                    self._arrays[name] = self._new_array(name, values)
                array = self._arrays[name]
                array[row : row + 1] = _chunk(array, values)
            self._arrays[DONE][row] = True
        self._done.add(key)

    def __getitem__(self, key: str) -> dict[str, NDArray[Any]]:
        """Return the result of a unit.

        Raises
        ------
        InputError
            When it cannot be read.
        """
        row = self._rows[key]
        names = [name for name, array in self._arrays.items() if name != DONE and array.shape[0] > row]
        try:
            return {name: _plain(self._arrays[name][row : row + 1][0]) for name in names}
        except Exception as error:  # a broken chunk makes each codec raise its own kind
            raise InputError(
                f"{self.path}: cannot be read: the store is damaged ({one_line(error)}): delete it"
            ) from None

    def _new_array(self, name: str, values: NDArray[np.generic]) -> object:
        text = values.dtype.kind in "UT"
        empty: object = "" if text else np.zeros((), values.dtype)[()]
        return self._group.create_array(
            name,
            shape=(len(self._rows), *values.shape),
            chunks=(1, *values.shape),
            dtype=str if text else values.dtype,
            fill_value=np.nan if values.dtype.kind == "f" else empty,
        )

    def _lengthen(self) -> None:
        """Make place for more units; that they are there is noted last."""
        with output_errors(self.path):
            for array in self._arrays.values():
                array.resize((len(self._rows), *array.shape[1:]))
            self._group.attrs[_UNITS] = list(self._rows)


def kind_of_store(path: Path) -> str | None:
    """Return what the units of a store are, such as "study"; None when there is something else."""
    kind = _attributes(path).get(_KIND)
    return kind if isinstance(kind, str) else None


def _attributes(path: Path) -> dict[str, object]:
    """Return the attributes of a store of units; none when there is something else."""
    try:
        attributes = stored_attributes(path)
        return attributes if _FINGERPRINT in attributes else {}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _check_path(path: Path, attributes: Mapping[str, object], *, overwrite: bool) -> None:
    """Refuse to write where there is anything but this experiment, or where `overwrite` another one."""
    kind = attributes[_KIND]
    if not path.absolute().parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist: create it or choose another")
    if not path.exists():
        return
    stored = _attributes(path)
    if stored.get(_KIND) != kind:
        raise InputError(f"{path}: already exists and is not the store of a {kind}; choose another name")
    if overwrite:
        return
    if stored[_FINGERPRINT] != attributes[_FINGERPRINT]:
        raise InputError(
            f"{path}: belongs to another {kind} ({stored.get('name', 'without a name')!r}, or other "
            "settings or another version): choose another name, or --overwrite"
        )


def _create(path: Path, attributes: dict[str, Any], template: xarray.Dataset | None) -> None:
    """Create the store, so that it is never seen half made."""
    with new_store(path, attributes) as group:
        if template is None:
            shape = (len(attributes[_UNITS]),)
            group.create_array(DONE, shape=shape, chunks=(1,), dtype=bool, fill_value=False)
            return
        encoding = {name: {"chunks": (1, *template[name].shape[1:])} for name in template.data_vars}
        # Zarr's format 3 knows texts of any length, but not NumPy's of a fixed one.
        texts = {name: c.astype(object) for name, c in template.coords.items() if c.dtype.kind == "U"}
        stored = template.assign_coords(texts).assign_attrs(attributes)
        stored.to_zarr(group.store, mode="a", zarr_format=3, consolidated=False, encoding=encoding)


def _chunk(array: Any, values: NDArray[np.generic]) -> NDArray[Any]:
    """Return one row of an array; what a smaller result does not fill stays "not there"."""
    shape = (1, *array.shape[1:])
    if shape[1:] == values.shape:
        return values[None].astype(object) if values.dtype.kind in "UT" else values[None]
    chunk = np.full(shape, np.nan)
    chunk[0, ..., : values.shape[-1]] = values
    return chunk


def _plain(values: object) -> NDArray[Any]:
    """Return NumPy's own texts for those of Zarr."""
    array = np.asarray(values)
    return np.asarray(array.tolist(), dtype=np.str_) if array.dtype.kind in "TO" else array
