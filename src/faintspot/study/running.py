"""Running a study: its cells are units of work, see `faintspot.compare.running`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from faintspot.compare.running import Advance, Unit, Workplace, run_units
from faintspot.compare.store import Arrays, MemoryStore
from faintspot.errors import InputError
from faintspot.study.cell import measure_cell
from faintspot.study.specification import StudySpecification
from faintspot.study.store import dataset_of, open_study, stored_units
from faintspot.study.sweep import Cell

if TYPE_CHECKING:
    import xarray


def run(
    specification: StudySpecification,
    store: str | Path | None = None,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] | None = None,
    *,
    workers: int | None = None,
    overwrite: bool = False,
    announce: Callable[[str], None] | None = None,
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
    scheduler : str, optional
        Address of a running Dask scheduler, such as "tcp://host:8786", whose workers have the same version
        of faintspot; docs/study.md says who may reach it. Without one, processes are started on this machine
        for the time of the run; a script must then call this function under ``if __name__ == "__main__":``.
    progress : callable, optional
        Called with the number of cells measured in this run and the number to measure.
    workers : int, optional
        Processes on this machine; as many as there are processors by default. 0 works in this process.
    overwrite : bool
        Replace the store, if it is one of a study.
    announce : callable, optional
        Called with a line of text that says where the work is done.

    Returns
    -------
    xarray.Dataset
        Dimensions cell, arm, mode, k, arm2; see `faintspot.study.store.VARIABLES`.

    Raises
    ------
    InputError
        When the store belongs to another study or cannot be written, or the scheduler is not to be reached.
    MissingExtraError
        When Dask is needed and not installed.

    Examples
    --------
    >>> from faintspot.study import StudySpecification, Sweep, run
    >>> light = Sweep("light", flux_e=[30, 100], pixels=8)
    >>> study = StudySpecification("mine", [light], realisations=200, arms=["brightest"], fixed_k=[])
    >>> results = run(study, workers=0)
    >>> dict(results.sizes)
    {'cell': 2, 'arm': 1, 'mode': 1, 'arm2': 1, 'k': 63}
    """
    if not isinstance(specification, StudySpecification):
        raise InputError(f"specification: expected a StudySpecification, got {type(specification).__name__}")
    place = Workplace(workers, scheduler, progress, announce)
    units = [Unit(str(index), (cell, specification)) for index, cell in enumerate(specification.cells())]
    if store is None:
        memory = MemoryStore()
        run_units(_measured, units, memory, place)
        return dataset_of(specification, memory)
    run_units(_measured, units, stored_units(specification, Path(store), overwrite=overwrite), place)
    return open_study(store)


def _measured(cell: Cell, specification: StudySpecification, advance: Advance) -> Arrays:
    return measure_cell(cell, specification)
