"""Benchmarks: `python -m benchmarks [NAME ...]`, `... compare [OLD NEW]`, in the root.

A run prints its tables and writes them, with the machine and the versions, as JSON;
those of benchmarks that are named also to docs/results/data, from where the documentation takes its figures.
"""

import importlib
import sys
import time
import traceback
from datetime import datetime
from pathlib import Path

import click

from benchmarks import compare, machine, results, showing
from benchmarks.loops import foreign_loops, night_frames
from benchmarks.measuring import Table
from benchmarks.paper import paper_night

_FOLDERS = {
    "frames": (
        "rivals",
        "scale",
        "projection",
        "estimators",
        "pictures",
        "roofline",
        "validity",
        "following",
        "layouts",
        "wavefronts",
        "metrology",
        "beams",
        "small_arrays",
        "backgrounds",
        "spot_widths",
    ),
    "loops": (
        "guard",
        "telemetry",
        "recorded_tip_tilt",
        "loop",
        "control",
        "prediction",
        "winds",
        "large_sensors",
    ),
    "realtime": (
        "realtime",
        "realtime_loop",
        "realtime_guard",
        "live_page",
        "latency",
        "realtime_sustained",
        "pyrtc",
        "pyrtc_loop",
        "darc",
        "streams",
        "startup",
    ),
    "": ("yardstick", "loaded"),
}
"""Benchmarks by folder; "": beside this file."""
MODULES = {
    name: ".".join(filter(None, ("benchmarks", folder, name)))
    for folder, names in _FOLDERS.items()
    for name in names
}
NAMES = tuple(MODULES)
LONG = {
    "darc",
    "guard",
    "following",
    "realtime_sustained",
    "telemetry",
    "recorded_tip_tilt",
    "winds",
    "large_sensors",
    "layouts",
    "wavefronts",
    "metrology",
    "beams",
    "small_arrays",
    "backgrounds",
    "spot_widths",
    "streams",
    "yardstick",
}
"""Run only when named, or with --full: 5 minutes to an hour each, one with a recording of its own."""
_FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
_FOLDER = click.option(
    "--folder",
    type=click.Path(file_okay=False, path_type=Path),
    default=results.FOLDER,
    show_default=True,
    help="Where results are.",
)


@click.command()
@click.argument("names", nargs=-1, type=click.Choice(NAMES))
@click.option("--full", is_flag=True, help=f"With {', '.join(sorted(LONG))}, too.")
@_FOLDER
@click.option(
    "--pages",
    type=click.Path(file_okay=False, path_type=Path),
    default=results.PAGES,
    show_default=True,
    help="Where benchmarks that are named write what the pages of the documentation show.",
)
def run(names: tuple[str, ...], full: bool, folder: Path, pages: Path) -> None:
    """Run the benchmarks NAMES, by default all but the long ones.

    Tables of benchmarks that are named go to the documentation, too.

    `python -m benchmarks compare` says what changed since the run before.
    """
    chosen = [name for name in names or NAMES if names or full or name not in LONG]
    found = results.Results(
        datetime.now().strftime("%Y-%m-%dT%H:%M:%S"), machine.fingerprint(), machine.versions()
    )
    for name, fact in {**found.fingerprint, **found.versions}.items():
        click.echo(f"{name:>22}  {fact}")
    try:
        for count, name in enumerate(chosen, start=1):
            click.echo(f"\n[{count}/{len(chosen)}] {name} ...")
            found.benchmarks.append(measured(name))
            results.write(found, folder)
            if names and not found.benchmarks[-1].failure:
                click.echo(results.publish(found, found.benchmarks[-1], pages))
            _show(found.benchmarks[-1])
    finally:  # an interrupted run keeps what is finished
        if found.benchmarks:
            click.echo(f"\n{folder / f'{found.stem}.json'}")
    if any(benchmark.failure for benchmark in found.benchmarks):
        sys.exit(1)


def measured(name: str) -> results.Benchmark:
    """Run one benchmark; when it fails, say why, so that the others can go on."""
    load, start = machine.load_average(), time.monotonic()
    failure = ""
    tables: list[Table] = []
    try:
        module = importlib.import_module(MODULES[name])
        tables = module.run()
    except Exception as error:
        traceback.print_exc()
        failure = f"{type(error).__name__}: {error}".splitlines()[0]
    return results.Benchmark(name, time.monotonic() - start, load, tables, failure)


def _show(benchmark: results.Benchmark) -> None:
    for table in benchmark.tables:
        showing.show(table)
    if benchmark.failure:
        click.echo(f"  FAILED: {benchmark.failure}")
    click.echo(f"  {benchmark.seconds:.0f} s; load average when it began: {benchmark.load}")


@click.command("compare")
@click.argument("files", nargs=-1, type=_FILE, metavar="[OLD NEW]")
@click.option("--anyway", is_flag=True, help="Compare different machines, too.")
@_FOLDER
def compare_runs(files: tuple[Path, ...], anyway: bool, folder: Path) -> None:
    """Say what changed beyond noise from OLD to NEW, by default the two newest of the same machine.

    The exit status is 1 when something got worse, 2 when the two cannot be compared.
    """
    if len(files) not in (0, 2):
        raise click.UsageError("expected two files, or none")
    try:
        old, new = files or compare.two_newest(folder, anyway=anyway)
        found, notes = compare.compare(old, new, anyway=anyway)
    except results.ResultsError as error:
        click.echo(str(error), err=True)
        sys.exit(2)
    compare.show(found, notes)
    sys.exit(any(change.verdict == compare.WORSE for change in found))


def main() -> None:
    """Run the command that the first argument names; without one, benchmarks."""
    commands = {"compare": compare_runs, "foreign_loops": foreign_loops.run_command}
    commands["night_frames"] = night_frames.run_command
    commands["paper_night"] = paper_night.run_command
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    if name in commands:
        commands[name](sys.argv[2:], prog_name=f"python -m benchmarks {name}")
    run(prog_name="python -m benchmarks")


if __name__ == "__main__":
    main()
