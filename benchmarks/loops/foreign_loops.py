"""Is the learnt filter better in loops that other packages simulate? `python -m benchmarks foreign_loops`

Atmosphere, telescope, sensor, noise and mirror are those of OOPAO, SPECULA, HCIPy and soapy. faintspot has
slopes and commands of 8 s with the tuned integrator, the interaction matrix and the frame rate. Gains are
chosen on one realisation, the filter learns from a second, and three others are scored. Differences are
paired. pyRTC's predictors have the slopes and the recording of the filter, tuned in a replay and then in the
loop. A difference in magnitudes is one of the guide star: the integrator, tuned at each flux, has the Strehl
ratio of the other control. The report of the recording is compared with the loop.
"""

import json
import sys
import tempfile
import time
import traceback
from pathlib import Path
from typing import Any

import click

from benchmarks import machine
from benchmarks.loops.foreign import evaluation
from benchmarks.loops.foreign.evaluation import INTEGRATOR, Effort
from benchmarks.loops.foreign.magnitudes import in_magnitudes
from benchmarks.loops.foreign.rows import ROWS, TOOLS, Row, chosen_rows, is_installed
from benchmarks.results import FOLDER, PAGES, origin_now, publish_tables
from faintspot.loop.telemetry.choices import FILTER

_COLUMNS = (
    "loop",
    "integrator (gain)",
    "own control",
    "best of pyRTC",
    "filter",
    "filter - integrator",
    "filter - pyRTC",
    "goal",
    "magnitudes: integrator, pyRTC",
    "delay; true",
    "centroid gain; true",
    "r0; true, m",
    "report's best; saves",
    "learning, frame, row",
)


@click.command()
@click.option("--tool", type=click.Choice(TOOLS), help="Rows of one package only.")
@click.option("--rows", "names", help=f"Some rows, with commas: {', '.join(row.name for row in ROWS)}.")
@click.option("--quick", is_flag=True, help="Two short realisations, 3 s to learn from, one gain, no rivals.")
@click.option(
    "--others/--no-others", default=True, show_default=True, help="pyRTC's controls and brighter stars, too."
)
@click.option("--again", is_flag=True, help="Run rows anew that the folder has results of.")
@click.option(
    "--folder",
    type=click.Path(file_okay=False, path_type=Path),
    default=FOLDER / "foreign_loops",
    show_default=True,
    help="Where each row is stored when it is finished, and the table.",
)
@click.option(
    "--cache",
    type=click.Path(file_okay=False, path_type=Path),
    help="Where turbulence and runs of controls that do not learn are kept. [default: temporary]",
)
def run_command(
    tool: str | None,
    names: str | None,
    quick: bool,
    others: bool,
    again: bool,
    folder: Path,
    cache: Path | None,
) -> None:
    """Compare the learnt filter with other controls in loops of other packages."""
    chosen = tuple(names.split(",")) if names else ()
    unknown = [name for name in chosen if name not in {row.name for row in ROWS}]
    if unknown:
        raise click.BadParameter(f"no row {unknown[0]}", param_hint="--rows")
    folder.mkdir(parents=True, exist_ok=True)
    effort = evaluation.QUICK if quick else Effort(with_others=others)
    with tempfile.TemporaryDirectory() as temporary:
        kept = Path(temporary) if cache is None else cache
        kept.mkdir(parents=True, exist_ok=True)
        rows = chosen_rows(tool, chosen)
        for count, row in enumerate(rows, start=1):
            path = folder / f"{row.name}.json"
            _log(f"[{count}/{len(rows)}] {row.name}: {row.title}")
            if not is_installed(row.tool):
                _log(f"{row.tool} is not installed")
            elif path.exists() and not again:
                _log(f"in {path} already; --again runs it anew")
            else:
                _measure(row, effort, kept, path)
    _finish(folder, rows)
    if not (tool or chosen or quick):
        publish(folder)


def _measure(row: Row, effort: Effort, cache: Path, path: Path) -> None:
    """Run a row and store its result, first without magnitudes, which take long; a failure is a result."""
    begun = time.perf_counter()
    result: dict[str, Any] = {"name": row.name, "title": row.title, "goal": row.goal}

    def runs(brightness: float) -> evaluation.Runs:
        return evaluation.Runs(row.make(cache, brightness), effort, cache)

    def store() -> None:
        result["seconds"] = time.perf_counter() - begun
        _write(path, result | {"versions": machine.versions()})

    try:
        ready = evaluation.commissioned(runs(1.0), _log)
        evaluate = (
            evaluation.changed if row.changed else evaluation.turned if row.turned else evaluation.compared
        )
        result |= evaluate(ready, _log)
        result |= {"learnt": evaluation.learnt(ready), "gains": ready.tried}
        store()
        if ready.runs.effort.with_others and not (row.turned or row.changed):
            result["magnitudes"] = in_magnitudes(result["scores"], runs, INTEGRATOR, ready.gain, _log)
    except Exception as error:
        traceback.print_exc()
        result["failure"] = f"{type(error).__name__}: {error}".splitlines()[0]
    store()
    _log(f"{row.name}: {result['seconds']:.0f} s")


def _finish(folder: Path, rows: list[Row]) -> None:
    """Print the table of all rows that are stored, and write it with all results as one file."""
    paths = [folder / f"{row.name}.json" for row in rows]
    results = [json.loads(path.read_text(encoding="utf-8")) for path in paths if path.exists()]
    table = table_of(results)
    click.echo(table)
    (folder / "table.md").write_text(table + "\n", encoding="utf-8")
    _write(folder / "all.json", results)


def publish(folder: Path, pages: Path = PAGES) -> Path:
    """Write the scores of all rows to the file that the documentation takes its figures from."""
    rows = []
    for result in json.loads((folder / "all.json").read_text(encoding="utf-8")):
        if "scores" in result:
            mean = {name: sum(values) / len(values) for name, values in result["scores"].items()}
            gain = result["chosen"][INTEGRATOR].removeprefix("gain ")
            cells = result["title"], f"{mean[INTEGRATOR]:.3f} ({gain})", f"**{mean[FILTER]:.3f}**"
            rows.append([*cells, _signed(result["ahead"][INTEGRATOR])])
    columns = ["loop", "integrator (gain)", "learnt filter", "filter - integrator"]
    table = {"title": "Loops of other simulators", "columns": columns, "rows": rows}
    return publish_tables(
        pages / "foreign_loops.json", {"loops": table}, origin_now("python -m benchmarks foreign_loops")
    )


def table_of(results: list[dict[str, Any]]) -> str:
    """Return the results as a Markdown table."""
    lines = ["| " + " | ".join(_COLUMNS) + " |", "|---" * len(_COLUMNS) + "|"]
    for result in results:
        if "scores" in result:
            lines.append("| " + " | ".join(_cells(result)) + " |")
        elif "failure" in result:
            lines.append(f"| {result['name']} | failed: {result['failure']} |")
    for result in results:
        for part, ahead in result.get("ahead_of_parts", {}).items():
            lines.append(f"\n{result['name']}, {part}: filter - integrator {_signed(ahead[INTEGRATOR])}")
    right = [result["report"]["is_best"] for result in results if result.get("report")]
    if right:
        lines.append(f"\nThe report's best control is the best in the loop in {sum(right)} of {len(right)}.")
    total = sum(result["seconds"] for result in results)
    return "\n".join([*lines, f"\n{len(results)} rows, {total / 60:.0f} minutes"])


def _cells(result: dict[str, Any]) -> list[str]:
    scores, ahead, chosen = result["scores"], result["ahead"], result["chosen"]
    learnt, report = result["learnt"], result["report"]
    mean = {name: sum(values) / len(values) for name, values in scores.items()}
    ours = INTEGRATOR, FILTER
    own = [name for name in scores if name not in ours and not name.startswith("pyRTC")]
    pyrtc = sorted((name for name in scores if name.startswith("pyRTC")), key=lambda name: mean[name])
    best = pyrtc[-1] if pyrtc else None
    magnitudes = result.get("magnitudes", {}).get("ahead", {})
    delay, error, true_delay = learnt["delay"]
    gain, gain_error, true_gain = learnt["centroid_gain"]
    return [
        f"{result['name']}: {result['title']}",
        f"{mean[INTEGRATOR]:.3f} ({chosen[INTEGRATOR].removeprefix('gain ')})",
        ", ".join(f"{mean[name]:.3f}" for name in own) or "-",
        f"{mean[best]:.3f} ({best.removeprefix('pyRTC ')})" if best else "-",
        f"{mean[FILTER]:.3f}",
        _signed(ahead[INTEGRATOR]),
        _signed(ahead[best]) if best else "-",
        "-" if result["goal"] is None else f"{result['goal']:g}",
        ", ".join(_magnitudes(magnitudes[name]) for name in (INTEGRATOR, best) if name in magnitudes) or "-",
        f"{delay:.2f} ± {error:.2f}; {true_delay}",
        f"{gain:.3f} ± {gain_error:.3f}" + ("" if true_gain != true_gain else f"; {true_gain:.3f}"),
        "{:.3f} ± {:.3f}; {:.3f}".format(*report["r0"]) if report and report["r0"] else "-",
        "{}; {:.3g} ({:.3g} to {:.3g})".format(report["best"], *report["saves"]) if report else "-",
        f"{learnt['learning_s']:.1f} s, {learnt['frame_us']:.0f} us, {result['seconds']:.0f} s",
    ]


def _magnitudes(ahead: list[float]) -> str:
    """Return a difference; without an error it is a lower limit."""
    return f"> {ahead[0]:.1f}" if ahead[1] != ahead[1] else f"{ahead[0]:.2f} ± {ahead[1]:.2f}"


def _signed(difference: list[float]) -> str:
    return f"{difference[0]:+.3f} ± {difference[1]:.3f}"


def _write(path: Path, content: Any) -> None:
    unfinished = path.with_suffix(".part")
    unfinished.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    unfinished.replace(path)


def _log(text: str) -> None:
    print(f"{time.strftime('%H:%M:%S')} {text}", file=sys.stderr, flush=True)
