"""faintspot estimators: which there are, and what their options mean."""

from __future__ import annotations

import click

from faintspot.cli.commands import option
from faintspot.estimators.documentation import all_tables, allowed_in_words, needs_in_words
from faintspot.estimators.registry import estimator_named, estimators


@click.command(short_help="List the estimators, or the options of one.")
@click.argument("name", required=False)
@option("--markdown", is_flag=True, help="Print the tables of the documentation.")
def command(name: str | None, markdown: bool) -> None:
    """List the estimators, those of installed packages too; or the options of the one that is named.

    \b
    Examples:
      faintspot estimators
      faintspot estimators tv
    """
    from rich.console import Console
    from rich.table import Table

    from faintspot.pipeline.settings import SharedOptions

    if markdown:
        for title, text in all_tables(SharedOptions).items():
            click.echo(f"{title}\n\n{text}\n")
        return
    table = Table(box=None, pad_edge=False)
    if name is None:
        for heading in ("name", "what it does", "needs"):
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
