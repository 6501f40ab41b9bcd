"""Running a study: its cells are spread over processes with Dask, their results gathered as they finish."""

from __future__ import annotations

import importlib
import importlib.util
import logging
import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, as_completed, wait
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from faintspot.checks import number_between
from faintspot.errors import InputError, MissingExtraError
from faintspot.kernels.parallel import available_cpus
from faintspot.study.cell import measure_cell, results_of, score_cell
from faintspot.study.specification import StudySpecification
from faintspot.study.store import MemoryResults, StoredResults
from faintspot.study.sweep import Cell

if TYPE_CHECKING:
    import xarray

_CONNECT_TIMEOUT_S = 10
_SETTINGS = {
    "distributed.scheduler.allowed-failures": 10,  # workers that may die on one cell
    # Workers keep freed memory for the next block, up to these sizes in bytes; Dask's own setting makes the
    # system clear it anew for every array, which takes a quarter of the time.
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 1 << 28,
    "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": 1 << 25,
}


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
        of faintspot. Without one, a cluster of processes is started on this machine for the time of the run;
        a script must then call this function under ``if __name__ == "__main__":``.
    progress : callable, optional
        Called with the number of cells measured in this run and the number to measure.
    workers : int, optional
        Processes of the cluster on this machine; all processors by default. 0 works in this process,
        without Dask. Of a study on a GPU, which one process drives: processes (without Dask) that work out
        the statistics of measured cells.
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
        When the store belongs to another study or cannot be written, or the scheduler is not to be reached;
        for a study on a GPU without one, with a scheduler, or with images of more than 32 x 32 pixels.
    MissingExtraError
        When Dask or, for a GPU, numba-cuda is needed and not installed.
    """
    if not isinstance(specification, StudySpecification):
        raise InputError(f"specification: expected a StudySpecification, got {type(specification).__name__}")
    if workers is not None:
        workers = int(number_between("workers", workers, 0, 10_000, integer=True))
    if specification.device != "cpu":
        _check_device(specification, scheduler)
    results: MemoryResults | StoredResults
    if store is None:
        results = MemoryResults(specification)
    else:
        results = StoredResults(Path(store), specification, overwrite=overwrite)
    cells = {i: cell for i, cell in enumerate(specification.cells()) if not results.done()[i]}
    if cells:
        finished = _finished_cells(specification, cells, scheduler, workers, announce or (lambda text: None))
        for count, (index, measured) in enumerate(finished, start=1):
            results.write(index, measured)
            if progress is not None:
                progress(count, len(cells))
    return results.dataset()


def _finished_cells(
    specification: StudySpecification,
    cells: dict[int, Cell],
    scheduler: str | None,
    workers: int | None,
    announce: Callable[[str], None],
) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield index and results of every cell as it finishes."""
    if specification.device != "cpu":
        yield from _cells_on_device(specification, cells, workers, announce)
        return
    if workers == 0 and scheduler is None:
        for index, cell in cells.items():
            yield index, measure_cell(cell, specification)
        return
    distributed = dask_distributed()
    with dask_client(scheduler, workers, len(cells)) as client:
        announce(f"Dask scheduler {client.scheduler.address}{dashboard(client)}")
        futures = {
            client.submit(
                _measure_on_worker, cell, specification, specification.fingerprint, pure=False
            ): index
            for index, cell in cells.items()
        }
        try:
            for future in distributed.as_completed(list(futures), loop=client.loop):
                yield futures.pop(future), future.result()
        except distributed.KilledWorker as error:
            raise InputError(f"workers died repeatedly, perhaps of lack of memory: {error}") from None
        finally:
            client.cancel(list(futures))


def _check_device(specification: StudySpecification, scheduler: str | None) -> None:
    """Refuse a study that this machine's GPU cannot run."""
    if scheduler is not None:
        raise InputError(
            f"scheduler = {scheduler!r}: device = {specification.device!r} works on this machine's GPU, "
            "not on a cluster; leave one of both out"
        )
    from faintspot.cuda.availability import check_cuda
    from faintspot.cuda.strips import strips_of

    for cell in specification.cells():
        strips_of((cell.pixels, cell.pixels))
    check_cuda()


def _cells_on_device(
    specification: StudySpecification,
    cells: dict[int, Cell],
    workers: int | None,
    announce: Callable[[str], None],
) -> Iterator[tuple[int, dict[str, Any]]]:
    """Measure cell after cell on the GPU, while other processes work out the results of those before."""
    processes = min(available_cpus() if workers is None else workers, len(cells))
    if processes == 0:
        for index, cell in cells.items():
            yield index, results_of(cell, specification, score_cell(cell, specification))
        return
    announce(f"GPU, and {processes} processes for the statistics")
    # A process that was forked could not go on with the driver's threads.
    with ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        pending: dict[Future[dict[str, Any]], int] = {}
        for index, cell in cells.items():
            scores = score_cell(cell, specification)
            pending[pool.submit(results_of, cell, specification, scores)] = index
            patience_s = None if len(pending) > 2 * processes else 0.0
            for future in wait(pending, patience_s, FIRST_COMPLETED).done:
                yield pending.pop(future), future.result()
        for future in as_completed(pending):
            yield pending[future], future.result()


def dask_distributed() -> Any:
    """Return the module, of which only a part is typed."""
    try:
        return importlib.import_module("distributed")
    except ImportError:
        raise MissingExtraError("dask[distributed]", "study", "Running on several processes") from None


def _measure_on_worker(cell: Cell, specification: StudySpecification, fingerprint: str) -> dict[str, Any]:
    """Measure a cell where the code is the same as where the study was started."""
    if specification.fingerprint != fingerprint:
        raise InputError("a worker has another version of faintspot: install the same on all")
    return measure_cell(cell, specification)


@contextmanager
def dask_client(scheduler: str | None, workers: int | None, n_cells: int) -> Iterator[Any]:
    """Connect to a running scheduler, or start a cluster of this machine's processes.

    Never as Dask's default: what else the process computes with Dask is not the study's.
    """
    import dask

    distributed = dask_distributed()
    if scheduler is not None:
        try:
            client = distributed.Client(scheduler, timeout=_CONNECT_TIMEOUT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(
                f"scheduler = {scheduler!r}: cannot be reached, expected an address such as "
                f"tcp://host:8786 ({' '.join(str(error).split())})"
            ) from None
        with client:
            yield client
        return
    options: dict[str, Any] = {
        "n_workers": min(available_cpus() if workers is None else workers, n_cells),
        "threads_per_worker": 1,
        "processes": True,
        "memory_limit": None,
        "dashboard_address": "localhost:0",
        "silence_logs": logging.CRITICAL,
    }
    with (
        dask.config.set(_SETTINGS),
        distributed.LocalCluster(**options) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        yield client


def dashboard(client: Any) -> str:
    """Return where the dashboard is; without Bokeh, which draws it, Dask links to a missing page."""
    link = client.dashboard_link
    return f", dashboard {link}" if link and importlib.util.find_spec("bokeh") else ""
