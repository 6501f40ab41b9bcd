"""A small loop, for the tests of the experiments: a 1.8 m telescope with 4 x 4 sub-apertures."""

from pathlib import Path
from typing import Any

from faintspot.experiments.closed_loop.search import Search
from faintspot.experiments.running import WorkerPool
from faintspot.loop.simulation.configuration import LoopConfiguration

SEARCH = Search(coarse_frames=20, frames=25, settle_frames=8, realisations=1, finalists=2, climbs=1, rounds=1)
HERE = WorkerPool(workers=0)


def small() -> LoopConfiguration:
    """One layer, 100 photons, 1 electron of read noise."""
    changes: dict[str, dict[str, Any]] = {
        "telescope": {"diameter_m": 1.8},
        "sensor": {"subapertures": 4, "pixels": 8, "samples": 9},
        "atmosphere": {
            "outer_scale_m": 5.0,
            "altitude_m": (0.0,),
            "fraction": (1.0,),
            "wind_speed_m_per_s": (8.0,),
            "wind_direction_deg": (30.0,),
        },
        "camera": {"photons_per_subaperture": 100.0, "read_noise_e": 1.0},
        "run": {"frames": 60, "settle_frames": 20, "realisations": 2},
    }
    configuration = LoopConfiguration(name="small")
    for section, values in changes.items():
        configuration = configuration.replace(section, **values)
    return configuration


class StopsAfter:
    """A progress that interrupts after so many calls."""

    def __init__(self, calls: int) -> None:
        self._calls = calls

    def __call__(self, finished: int, total: int) -> None:
        self._calls -= 1
        if self._calls < 0:
            raise KeyboardInterrupt


def assert_same_files(one: Path, other: Path) -> None:
    """Two folders hold the same files, bit for bit."""
    found, expected = (
        {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        for folder in (one, other)
    )
    assert found.keys() == expected.keys()
    assert [name for name in found if found[name] != expected[name]] == []
