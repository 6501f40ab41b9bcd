"""The turbulence of a night from frames that other packages make: `python -m benchmarks night_frames`

OOPAO, SPECULA, HCIPy and soapy make noiseless frames of an open loop; photon noise, read noise and whole ADU
are added here. `faintspot layout`, `slopes` and `telemetry` run on them as a user runs them, who knows
telescope diameter, pixel scale and frame rate. r0 is compared with that of the package's own wavefronts, from
their structure function over all realisations.
"""

import cmath
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np

from benchmarks.loops.foreign.movies import NIGHTS, Night, movie, r0_of_paths
from benchmarks.loops.foreign.rows import is_installed
from benchmarks.results import FOLDER, PAGES, origin_now, publish_tables

FLUXES_E = (20.0, 200.0)
_OFFSET_ADU, _MARGIN_PX = 100, 8
_LEAST_SHARE = 0.15  # of a layer, for its wind to be compared
_WITHIN = {"r0": 0.05, "tau0": 0.10, "speed": 1.0, "direction": 5.0}
_NAMES = {
    "r0": "r0 at 500 nm",
    "motion": "r0 at 500 nm from differential image motion",
    "tau0": "coherence time at 500 nm",
}

_COLUMNS = (
    "frames",
    "r0, nominal; of wavefronts (m)",
    "r0 / true",
    "from image motion",
    "coherence time / true",
    "winds: rms (m/s, degrees)",
    "within goal",
    "intervals that hold",
    "of pieces",
)

Values = dict[str, dict[str, float]]
"""A report's values by name, each with its value and the ends of its interval."""


@click.command()
@click.option("--tools", default=",".join(night.tool for night in NIGHTS), show_default=True)
@click.option("--seeds", default="4,5,6", show_default=True, help="Realisations that chose nothing.")
@click.option(
    "--every", default=0.0, show_default=True, help="Length of pieces to report as well [s]; 0: none."
)
@click.option("--again", is_flag=True, help="Run anew what the folder has results of.")
@click.option(
    "--folder",
    type=click.Path(file_okay=False, path_type=Path),
    default=FOLDER / "night_frames",
    show_default=True,
    help="Where the results of each movie are stored, and the table.",
)
@click.option(
    "--cache", type=click.Path(file_okay=False, path_type=Path), help="Where movies are kept.", required=True
)
def run_command(tools: str, seeds: str, every: float, again: bool, folder: Path, cache: Path) -> None:
    """Compare r0, coherence time and winds of movies of spots with the truth."""
    folder.mkdir(parents=True, exist_ok=True)
    cache.mkdir(parents=True, exist_ok=True)
    numbers = [int(seed) for seed in seeds.split(",")]
    nights = [night for night in NIGHTS if night.tool in tools.split(",") and is_installed(night.tool)]
    for seed in numbers:
        for night in nights:
            for flux_e in FLUXES_E:
                path = folder / f"{night.tool}-{flux_e:g}-{seed}.json"
                if again or not path.exists():
                    begun = time.perf_counter()
                    path.write_text(json.dumps(_measured(night, seed, flux_e, every, cache)) + "\n")
                    print(f"{path}: {time.perf_counter() - begun:.0f} s", file=sys.stderr, flush=True)
    table = table_of(nights, numbers, folder)
    click.echo(table)
    (folder / "table.md").write_text(table + "\n", encoding="utf-8")
    if nights == list(NIGHTS):
        publish(table, f"python -m benchmarks night_frames --cache FOLDER --seeds {seeds}")


def publish(table: str, command: str, pages: Path = PAGES) -> Path:
    """Write the table of all packages to the file that the documentation takes its figures from."""
    lines = [line for line in table.splitlines() if line.startswith("| ")]
    columns, *rows = [[cell.strip() for cell in line.strip("| ").split("|")] for line in lines]
    shown = {"title": "Turbulence from frames without a loop", "columns": columns, "rows": rows}
    return publish_tables(pages / "night_frames.json", {"nights": shown}, origin_now(command))


def _measured(night: Night, seed: int, flux_e: float, every_s: float, cache: Path) -> dict[str, Any]:
    """Run the three commands on a movie; return their numbers and the r0 of its wavefronts."""
    frames, paths_m = movie(night, cache, seed)
    rng = np.random.default_rng([seed, round(flux_e)])
    noise = night.read_noise_e(flux_e)
    with tempfile.TemporaryDirectory() as folder:
        seen = np.empty((len(frames), *(length + 2 * _MARGIN_PX for length in frames.shape[1:])), np.uint16)
        for row, frame in zip(seen, frames, strict=True):
            electrons = rng.poisson(np.pad(flux_e * np.maximum(frame, 0), _MARGIN_PX))
            row[:] = np.rint(electrons + rng.normal(_OFFSET_ADU, noise, electrons.shape))
        np.save(Path(folder) / "night.npy", seen)
        told = f"--pixel-scale-arcsec {night.pixel_scale_arcsec} --diameter-m {night.diameter_m}"
        said = _faintspot(f"layout night.npy {told}", folder)
        _faintspot("slopes night.npy --config faintspot.toml -o slopes.zarr", folder)
        pieces = f" --every {every_s:g}" if every_s else ""
        _faintspot(f"telemetry slopes.zarr --frame-rate-hz {night.rate_hz:g}{pieces}", folder)
        report = json.loads((Path(folder) / "slopes.json").read_text(encoding="utf-8"))
    return {
        "screens_r0_m": r0_of_paths(paths_m, night.diameter_m / paths_m.shape[-1]),
        "layout": said,
        "whole": _by_name(report["turbulence"]["known"]),
        "pieces": [_by_name(piece["known"]) for piece in report.get("over_time", [])],
        "missing": report["turbulence"]["missing"],
    }


def _faintspot(command: str, folder: str) -> str:
    words = [sys.executable, "-m", "faintspot", *command.split()]
    ran = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False, env=os.environ)
    if ran.returncode:
        raise RuntimeError(f"{command}: {ran.stderr}")
    return ran.stdout


def _by_name(known: Iterable[dict[str, Any]]) -> Values:
    return {each["name"]: {key: each[key] for key in ("value", "low", "high")} for each in known}


def table_of(nights: Sequence[Night], seeds: Sequence[int], folder: Path) -> str:
    """Return the results as a Markdown table: a row for each package and flux, and one of all."""
    lines = [
        "| " + " | ".join(_COLUMNS) + " |",
        "|---" * len(_COLUMNS) + "|",
    ]
    held, held_of_pieces, close = [], [], []
    for night in nights:
        for flux_e in FLUXES_E:
            paths = [folder / f"{night.tool}-{flux_e:g}-{seed}.json" for seed in seeds]
            found = [json.loads(path.read_text(encoding="utf-8")) for path in paths if path.exists()]
            if found:
                line, whole, pieces, near = _row(night, flux_e, found)
                lines.append(line)
                held += whole
                held_of_pieces += pieces
                close += near
    shown = ", ".join(
        f"{name} {np.mean([hit for other, hit in close if other == name]):.0%}" for name in _WITHIN
    )
    return "\n".join(
        [
            *lines,
            "",
            f"Within the goals: {shown}.",
            f"Intervals that hold: {_share(held)}; of pieces: {_share(held_of_pieces)}.",
        ]
    )


def _row(
    night: Night, flux_e: float, found: list[dict[str, Any]]
) -> tuple[str, list[bool], list[bool], list[Any]]:
    """Return a row of the table, which intervals hold, of the whole and of pieces, and goals that are met."""
    r0_m = float(np.mean([each["screens_r0_m"] for each in found]))
    truth = {"r0": r0_m, "motion": r0_m, "tau0": night.tau0_ms * r0_m / night.r0_m}
    ratios: dict[str, list[float]] = {
        name: [each["whole"].get(known, {}).get("value") or math.nan for each in found]
        for name, known in _NAMES.items()
    }
    whole = [hit for each in found for hit in _holding(each["whole"], truth)]
    pieces = [hit for each in found for piece in each["pieces"] for hit in _holding(piece, truth)]
    close = [
        (name, bool(abs(value / truth[name] - 1) < _WITHIN[name]))
        for name in ("r0", "tau0")
        for value in ratios[name]
    ]
    winds = [wind for each in found for wind in _winds(each["whole"], night)]
    whole += [hit for wind in winds for hit in wind[2:]]
    apart = np.array([wind[:2] for wind in winds])
    close += [("speed", bool(abs(speed) < _WITHIN["speed"])) for speed in apart[:, 0]]
    close += [("direction", bool(abs(angle) < _WITHIN["direction"])) for angle in apart[:, 1]]
    rms = np.sqrt(np.square(apart).mean(axis=0))
    within = (np.abs(apart) < [_WITHIN["speed"], _WITHIN["direction"]]).all(axis=1)
    shown = {name: ", ".join(f"{value / truth[name]:.2f}" for value in ratios[name]) for name in ratios}
    cells = [
        f"{night.tool}, {flux_e:g} e-, {night.read_noise_e(flux_e):g} e-",
        f"{night.r0_m:.3f}, {r0_m:.3f}",
        *shown.values(),
        f"{rms[0]:.1f}, {rms[1]:.1f}",
        f"{within.sum()} of {len(within)}",
        _share(whole),
        _share(pieces),
    ]
    return "| " + " | ".join(cells) + " |", whole, pieces, close


def _holding(values: Values, truth: dict[str, float]) -> list[bool]:
    """Return whether the intervals of r0, by both methods, and of the coherence time hold."""
    known = [(values[_NAMES[name]], true) for name, true in truth.items() if _NAMES[name] in values]
    return [each["low"] <= true <= each["high"] for each, true in known if each["low"] is not None]


def _winds(values: Values, night: Night) -> list[tuple[float, float, bool, bool]]:
    """Return differences of the nearest winds from the true ones, and whether their intervals hold."""
    numbers = [name.partition(":")[0] for name in values if name.endswith(": share")]
    layers = [[values[f"{number}: {what}"] for what in ("speed", "direction")] for number in numbers]
    winds = np.array([cmath.rect(speed["value"], math.radians(angle["value"])) for speed, angle in layers])
    result = []
    for share, (speed, angle) in zip(night.shares, night.winds, strict=True):
        if share < _LEAST_SHARE:
            continue
        if not len(winds):
            result.append((math.inf, math.inf, False, False))
            continue
        true = cmath.rect(speed, math.radians(angle))
        nearest = int(np.argmin(np.abs(winds - true)))
        known_speed, known_angle = layers[nearest]
        turned = math.degrees(cmath.phase(winds[nearest] / true))
        half = 0.5 * (known_angle["high"] - known_angle["low"])
        holds = known_speed["low"] <= speed <= known_speed["high"], abs(turned) <= half
        result.append((known_speed["value"] - speed, turned, *holds))
    return result


def _share(held: Sequence[bool]) -> str:
    return f"{sum(held)} of {len(held)} ({np.mean(held):.0%})" if held else "-"
