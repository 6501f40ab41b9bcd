"""A study as a dataset: run it, store it, open it."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from faintspot.base import __version__
from faintspot.base.errors import InputError, MissingExtraError, drawn
from faintspot.base.report.texts import Texts
from faintspot.base.statistics import OUTLIER_PX
from faintspot.experiments.running import Advance, Unit, WorkerPool, run_units
from faintspot.experiments.store import DONE, OWN_ATTRIBUTES, Arrays, UnitStore, ZarrStore, kind_of_store
from faintspot.experiments.study.cell import measure_cell
from faintspot.experiments.study.specification import StudySpecification
from faintspot.experiments.study.sweep import PARAMETERS, RANGES, Cell
from faintspot.io.stored_array import one_line

if TYPE_CHECKING:
    import xarray


try:
    import xarray
except ImportError:
    raise MissingExtraError("xarray", "loop", "A study") from None

VARIABLES: dict[str, tuple[tuple[str, ...], str, str]] = {
    name: (tuple(dimensions.split()), units, description.format(outlier=OUTLIER_PX))
    for name, (dimensions, units, description) in Texts("faintspot.experiments")["variables"].items()
}
"""Dimensions, units and description of every variable but `done`."""

KIND = "study"


@xarray.register_dataset_accessor("faintspot")  # type: ignore[no-untyped-call]
class StudyFigures:
    """Figures of a study, the accessor `faintspot` of its dataset.

    Parameters
    ----------
    dataset : xarray.Dataset
        From `run` or `open_study`.
    """

    def __init__(self, dataset: xarray.Dataset) -> None:
        self._dataset = dataset

    def plot(self, figure: str | None = None, axes: Any = None) -> Any:
        """Draw a figure of the page of `faintspot report`.

        Parameters
        ----------
        figure : str, optional
            Its name; default: the first one.
        axes : array of matplotlib Axes, optional
            As many as it has panels. Default: new ones.

        Returns
        -------
        Axes or (n,) array of Axes

        Raises
        ------
        InputError
            If there is no such figure, as of a study of which no cell is finished.
        MissingExtraError
            If matplotlib is not installed.
        """
        return drawn("experiments.report:plot_study", self._dataset, figure, axes)


def new_dataset(specification: StudySpecification) -> xarray.Dataset:
    """Return the dataset of a study with all coordinates, filled with NaN, no cell done."""
    cells = specification.cells()
    sizes = {
        "cell": len(cells),
        "estimator": len(specification.estimators),
        "estimator2": len(specification.estimators),
        "mode": len(specification.modes),
        "k": specification.largest_k,
    }
    variables: dict[str, object] = {
        name: (
            dims,
            np.full([sizes[dim] for dim in dims], np.nan),
            {"units": units, "long_name": description},
        )
        for name, (dims, units, description) in VARIABLES.items()
    }
    variables[DONE] = (("cell",), np.zeros(len(cells), bool), {"long_name": "whether the cell is measured"})
    coordinates: dict[str, object] = {
        "estimator": np.array(specification.estimators),
        "estimator2": np.array(specification.estimators),
        "mode": np.array(specification.modes),
        "k": ("k", np.arange(1, sizes["k"] + 1), {"units": "px", "long_name": "number of kept pixels"}),
    }
    for name in PARAMETERS:
        units = {"units": RANGES[name].unit} if name in RANGES else {}
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

    Examples
    --------
    >>> from faintspot.experiments import StudySpecification, Sweep, WorkerPool, open_study, run
    >>> light = Sweep("light", flux_e=[30, 100], pixels=8)
    >>> study = StudySpecification("mine", [light], realisations=200, estimators=["brightest"], fixed_k=[])
    >>> _ = run(study, "mine.zarr", pool=WorkerPool(workers=0))
    >>> results = open_study("mine.zarr")
    >>> bool(results["done"].all()), results["error"].dims
    (True, ('cell', 'estimator', 'mode'))
    """
    path = Path(path)
    if kind_of_store(path) != KIND:
        contents = "something else" if path.exists() else "nothing"
        raise InputError(f"{path}: expected the Zarr store of a study, found {contents}")
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
    for name in OWN_ATTRIBUTES:
        dataset.attrs.pop(name, None)
    return dataset


def stored_units(specification: StudySpecification, path: Path, *, overwrite: bool = False) -> ZarrStore:
    """Return the store of a study's cells, created or continued.

    Raises
    ------
    InputError
        When there is something else than a store of this study, or it cannot be written.
    """
    keys = [str(index) for index in range(len(specification.cells()))]
    template = new_dataset(specification)
    return ZarrStore(path, KIND, specification.fingerprint, keys, template=template, overwrite=overwrite)


def dataset_of(specification: StudySpecification, units: UnitStore) -> xarray.Dataset:
    """Return the results of cells that are in memory; a smaller window has fewer k."""
    dataset = new_dataset(specification)
    for index in range(dataset.sizes["cell"]):
        if str(index) in units:
            for name, values in units[str(index)].items():
                target = dataset[name].values
                if values.ndim:
                    target[index][..., : values.shape[-1]] = values
                else:
                    target[index] = values
            dataset[DONE].values[index] = True
    return dataset


def run(
    specification: StudySpecification,
    store: str | Path | None = None,
    *,
    pool: WorkerPool | None = None,
    overwrite: bool = False,
) -> xarray.Dataset:
    """Run a study, or what is left of it.

    Results depend on the specification alone: not on the number of workers, the order in which cells finish,
    or interruptions.

    Parameters
    ----------
    specification : StudySpecification
    store : path, optional
        Zarr store to write every cell to as it finishes, and to go on with when it is there. Without one,
        results are in memory only.
    pool : WorkerPool, optional
        Where the work is done; its progress is called with the number of finished cells and of all, if
        any are missing. Default: processes on this machine.
    overwrite : bool
        Replace the store, if it is one of a study.

    Returns
    -------
    xarray.Dataset
        Dimensions cell, estimator, mode, k, estimator2; see `faintspot.experiments.study.run.VARIABLES`.

    Raises
    ------
    InputError
        When the store belongs to another study or cannot be written, or the scheduler cannot be reached.

    Examples
    --------
    >>> from faintspot.experiments import StudySpecification, Sweep, WorkerPool, run
    >>> light = Sweep("light", flux_e=[30, 100], pixels=8)
    >>> study = StudySpecification("mine", [light], realisations=200, estimators=["brightest"], fixed_k=[])
    >>> results = run(study, pool=WorkerPool(workers=0))
    >>> dict(results.sizes)
    {'cell': 2, 'estimator': 1, 'mode': 1, 'estimator2': 1, 'k': 63}
    """
    if not isinstance(specification, StudySpecification):
        raise InputError(f"specification: expected a StudySpecification, got {type(specification).__name__}")
    pool = pool or WorkerPool()
    units = [Unit(str(index), (cell, specification)) for index, cell in enumerate(specification.cells())]
    if store is None:
        return dataset_of(specification, run_units(_measured, units, {}, pool))
    run_units(_measured, units, stored_units(specification, Path(store), overwrite=overwrite), pool)
    return open_study(store)


def _measured(cell: Cell, specification: StudySpecification, advance: Advance) -> Arrays:
    return measure_cell(cell, specification)
