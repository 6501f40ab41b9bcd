"""faintspot estimators: which there are, and what their options mean."""

from __future__ import annotations

import click

from faintspot.slopes.estimators.registry import allowed_in_words, estimator_named, estimators, needs_in_words


@click.command()
@click.argument("name", required=False)
def command(name: str | None) -> None:
    """List all estimators, those of installed packages included, or the options of the named one.

    \b
    Examples:
      faintspot estimators
      faintspot estimators tv
    """
    from rich.console import Console
    from rich.table import Table

    from faintspot.slopes.pipeline.settings import SharedOptions

    table = Table(box=None, pad_edge=False)
    if name is None:
        for heading in ("name", "method", "requires"):
            table.add_column(heading)
        for own, kind in estimators().items():
            table.add_row(own, kind.method or kind.label, needs_in_words(kind))
    else:
        kind = estimator_named(name)
        for heading in ("option", "default", "allowed", "meaning"):
            table.add_column(heading)
        for owner in (kind, SharedOptions):
            defaults = owner.defaults()
            for option, declared in owner.declared().items():
                default = "" if defaults[option] is None else str(defaults[option])
                table.add_row(option, default, allowed_in_words(declared), declared.meaning)
    Console().print(table)
