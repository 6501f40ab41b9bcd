"""The results of a study: a dataset, in memory or in a Zarr store (format 3) with one chunk a cell.

In a store, all variables of a cell are written first, then its `done`. However the program ends, a cell that
is done is whole; the others are measured again.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot import __version__
from faintspot.errors import InputError, MissingExtraError
from faintspot.io.locations import one_line
from faintspot.io.slopes_format import output_errors
from faintspot.study.metric import OUTLIER_PX
from faintspot.study.specification import StudySpecification
from faintspot.study.stored_results import study_attributes
from faintspot.study.sweep import PARAMETERS, RANGES

try:
    import xarray
except ImportError:
    raise MissingExtraError("xarray", "study", "A study") from None

_R = "mean of (|dx| + |dy|) / 2 over the scored realisations"
VARIABLES: dict[str, tuple[tuple[str, ...], str, str]] = {
    "error": (("cell", "arm", "mode"), "px", f"slope error R: {_R}"),
    "error_se": (("cell", "arm", "mode"), "px", "standard error of R"),
    "error_covariance": (("cell", "mode", "arm", "arm2"), "px2", "covariance of the arms' R"),
    "chosen_k": (("cell", "arm", "mode"), "px", "number of kept pixels"),
    "chosen_candidate": (
        ("cell", "arm", "mode"),
        "tv, thresholded: noise of a mean pixel; gaussian, matched, ml, map: px; weighted: width of the spot",
        "strength, width, threshold or blur chosen",
    ),
    "chosen_model_error": (("cell", "arm", "mode"), "1", "model error chosen by an arm with a PSF"),
    "error_at_k": (("cell", "arm", "k"), "px", "R for every number of kept pixels, candidate as in best"),
    "error_at_k_se": (("cell", "arm", "k"), "px", "standard error of R for every number of kept pixels"),
    "invalid_fraction": (("cell", "arm", "mode"), "1", "fraction of positions without light, taken as 0"),
    "gain": (("cell", "arm", "mode"), "1", "slope of the estimate against the truth, x and y pooled"),
    "gain_se": (("cell", "arm", "mode"), "1", "standard error of the gain"),
    "rms": (("cell", "arm", "mode"), "px", "root of the mean of (dx^2 + dy^2) / 2"),
    "rms_se": (("cell", "arm", "mode"), "px", "standard error of the rms"),
    "corrected_rms": (("cell", "arm", "mode"), "px", "rms after offset and gain are taken off"),
    "corrected_rms_se": (("cell", "arm", "mode"), "px", "standard error of the gain-corrected rms"),
    "outlier_fraction": (("cell", "arm", "mode"), "1", f"fraction of errors beyond {OUTLIER_PX:g} px"),
    "outlier_fraction_se": (("cell", "arm", "mode"), "1", "standard error of the fraction of outliers"),
    "photon_efficiency": (
        ("cell", "arm", "mode"),
        "1",
        "flux at which the Cramer-Rao bound has the arm's R, over the flux",
    ),
    "stated_over_actual": (
        ("cell", "arm"),
        "1",
        f"stated over actual rms error of slopes whose error is below {OUTLIER_PX:g} px, mode best",
    ),
    "stated_over_actual_all": (("cell", "arm"), "1", "the same for all slopes"),
    "bound": (("cell",), "px", "R of an estimator at the Cramer-Rao bound, over the cell's positions"),
    "bound_rms": (("cell",), "px", "rms of the same"),
}
"""Dimensions, units and description of every variable but `done`."""

_DONE = "done"


def new_dataset(specification: StudySpecification) -> xarray.Dataset:
    """Return the dataset of a study with all coordinates, filled with NaN, no cell done."""
    cells = specification.cells()
    sizes = {
        "cell": len(cells),
        "arm": len(specification.arms),
        "arm2": len(specification.arms),
        "mode": len(specification.modes),
        "k": specification.largest_k,
    }
    variables: dict[str, Any] = {
        name: (
            dims,
            np.full([sizes[dim] for dim in dims], np.nan),
            {"units": units, "long_name": description},
        )
        for name, (dims, units, description) in VARIABLES.items()
    }
    variables[_DONE] = (("cell",), np.zeros(len(cells), bool), {"long_name": "whether the cell is measured"})
    coordinates: dict[str, Any] = {
        "arm": np.array(specification.arms),
        "arm2": np.array(specification.arms),
        "mode": np.array(specification.modes),
        "k": ("k", np.arange(1, sizes["k"] + 1), {"units": "px", "long_name": "number of kept pixels"}),
    }
    for name in PARAMETERS:
        units = {"units": RANGES[name].units} if name in RANGES else {}
        coordinates[name] = ("cell", np.array([asdict(cell)[name] for cell in cells]), units)
    attributes = {
        "name": specification.name,
        "specification": specification.to_text(),
        "seed": specification.seed,
        "n": specification.realisations,
        "fingerprint": specification.fingerprint,
        "faintspot_version": __version__,
    }
    return xarray.Dataset(variables, coordinates, attributes)


def open_study(path: str | Path) -> xarray.Dataset:
    """Return the results of a study from its Zarr store, also of one that is not finished.

    Raises
    ------
    InputError
        When there is no study, or the store is damaged.
    """
    path = Path(path)
    if study_attributes(path) is None:
        raise InputError(f"{path}: expected the Zarr store of a study, found {_what_is_at(path)}")
    try:
        dataset: xarray.Dataset = xarray.open_zarr(path, chunks=None, consolidated=False).load()
    except Exception as error:  # a broken chunk makes each codec raise its own kind
        raise InputError(f"{path}: cannot be read: the store is damaged ({one_line(error)})") from None
    missing = [name for name in (*VARIABLES, *PARAMETERS) if name not in dataset.variables]
    if missing:
        raise InputError(f"{path}: has no {missing[0]}: measured by another version, measure it again")
    for name, coordinate in dataset.coords.items():
        if coordinate.dtype.kind == "T":  # as in memory: Zarr's texts have a type of their own
            dataset[name] = (coordinate.dims, np.array(coordinate.values.tolist()), coordinate.attrs)
    return dataset


class MemoryResults:
    """Results in memory."""

    def __init__(self, specification: StudySpecification) -> None:
        self._dataset = new_dataset(specification)

    def done(self) -> NDArray[np.bool_]:
        """Return which cells are measured."""
        return np.asarray(self._dataset[_DONE].values)

    def write(self, index: int, results: Mapping[str, NDArray[Any]]) -> None:
        """Add a cell."""
        for name, values in results.items():
            _place(self._dataset[name].values, index, values)
        self._dataset[_DONE].values[index] = True

    def dataset(self) -> xarray.Dataset:
        """Return the results."""
        return self._dataset


class StoredResults:
    """Results in a Zarr store, made or gone on with.

    Parameters
    ----------
    path : Path
    specification : StudySpecification
    overwrite : bool
        Replace the store of another study.

    Raises
    ------
    InputError
        When there is something else than a store of this study, or it cannot be written.
    """

    def __init__(self, path: Path, specification: StudySpecification, *, overwrite: bool = False) -> None:
        self._path = path
        _check_target(path, specification, overwrite=overwrite)
        with output_errors(path):
            if overwrite and path.exists():
                shutil.rmtree(path)
            if not path.exists():
                _create(path, specification)
            for remains in path.rglob("*.partial"):  # of a program that was killed while it wrote
                remains.unlink(missing_ok=True)
        import zarr

        try:
            group: Any = zarr.open_group(str(path), mode="r+")
            self._arrays: dict[str, Any] = {name: group[name] for name in (*VARIABLES, _DONE)}
            self._done = np.asarray(self._arrays[_DONE][:]).astype(bool)
        except Exception as error:  # broken metadata makes zarr raise many things
            raise InputError(
                f"{path}: damaged, it cannot be resumed: delete it ({one_line(error)})"
            ) from None

    def done(self) -> NDArray[np.bool_]:
        """Return which cells are measured."""
        return self._done.copy()

    def write(self, index: int, results: Mapping[str, NDArray[Any]]) -> None:
        """Write a cell, each variable as one chunk, and then that it is done."""
        with output_errors(self._path):
            for name, values in results.items():
                array = self._arrays[name]
                chunk = np.full((1, *array.shape[1:]), np.nan)
                _place(chunk, 0, values)
                array[index : index + 1] = chunk
            self._arrays[_DONE][index] = 1
        self._done[index] = True

    def dataset(self) -> xarray.Dataset:
        """Return the results."""
        return open_study(self._path)


def _place(target: NDArray[Any], index: int, values: NDArray[Any]) -> None:
    """Write a cell's values; a smaller window has fewer k."""
    if values.ndim:
        target[index][..., : values.shape[-1]] = values
    else:
        target[index] = values


def _create(path: Path, specification: StudySpecification) -> None:
    """Create the store under a hidden name and rename it, so that it is never seen half made."""
    hidden = path.with_name(f".{path.name}.new")
    shutil.rmtree(hidden, ignore_errors=True)
    dataset = new_dataset(specification)
    encoding = {name: {"chunks": (1, *dataset[name].shape[1:])} for name in dataset.data_vars}
    # Zarr's format 3 knows texts of any length, but not NumPy's of a fixed one.
    texts = {name: c.astype(object) for name, c in dataset.coords.items() if c.dtype.kind == "U"}
    stored = dataset.assign_coords(texts)
    stored.to_zarr(hidden, mode="w", zarr_format=3, consolidated=False, encoding=encoding)
    hidden.rename(path)


def _what_is_at(path: Path) -> str:
    return "something else" if path.exists() else "nothing"


def _check_target(path: Path, specification: StudySpecification, *, overwrite: bool) -> None:
    """Refuse to write where there is anything but this study, or where `overwrite` another one."""
    if not path.absolute().parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist: create it or choose another")
    if not path.exists():
        return
    attributes = study_attributes(path)
    if attributes is None:
        raise InputError(f"{path}: exists already and is not the store of a study: choose another name")
    if attributes["fingerprint"] != specification.fingerprint and not overwrite:
        raise InputError(
            f"{path}: belongs to another study ({attributes.get('name', 'without a name')!r}, or other "
            f"settings or another version): choose another name, or --overwrite"
        )
