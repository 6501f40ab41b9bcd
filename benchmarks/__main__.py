"""Run benchmarks: `python -m benchmarks [NAME ...] [--json FILE]` in the root of the project."""

from __future__ import annotations

import importlib
import json
from pathlib import Path

import click

from benchmarks import measuring

NAMES = (
    "rivals",
    "estimators",
    "realtime",
    "realtime_sustained",
    "pyrtc",
    "loop",
    "roofline",
    "startup",
    "breakdown",
    "study",
)


@click.command()
@click.argument("names", nargs=-1, type=click.Choice(NAMES))
@click.option(
    "--json", "json_path", type=click.Path(dir_okay=False, path_type=Path), help="Write all numbers."
)
def main(names: tuple[str, ...], json_path: Path | None) -> None:
    """Run the benchmarks NAMES, by default all."""
    facts = measuring.machine()
    for name, fact in facts.items():
        click.echo(f"{name:>22}  {fact}")
    tables = []
    for name in names or NAMES:
        for table in importlib.import_module(f"benchmarks.{name}").run():
            measuring.show(table)
            tables.append(table)
    if json_path is not None:
        json_path.write_text(json.dumps(measuring.as_json(tables, facts), indent=1) + "\n")


if __name__ == "__main__":
    main()
