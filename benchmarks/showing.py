"""Tables in the terminal."""

from benchmarks.measuring import Table


def number(value: float) -> str:
    """Return three significant digits, or a whole number; counts are of type int."""
    if isinstance(value, int) or (abs(value) >= 10 and value == round(value)):
        return f"{value:.0f}"
    if 0 < abs(value) < 1e-3:
        return f"{value:.0e}"
    digits = 0 if abs(value) >= 100 else 1 if abs(value) >= 10 else 2 if abs(value) >= 1 else 3
    return f"{value:.{digits}f}"


def met(value: bool | None) -> str:
    """Return whether a target is met, in a word."""
    return "" if value is None else "yes" if value else "NO"


def grid(table: Table) -> tuple[list[str], list[list[str]]]:
    """Return the header and the rows of a table as text."""
    columns = list(dict.fromkeys(column for row in table.rows for column in row.values))
    with_targets = any(row.target for row in table.rows)
    header = ["", *columns, *(["target", "met"] if with_targets else [])]
    rows = []
    for row in table.rows:
        cells = [row.name] + [number(row.values[c]) if c in row.values else "" for c in columns]
        rows.append(cells + ([row.target, met(row.met)] if with_targets else []))
    return header, rows


def show(table: Table) -> None:
    """Print a table."""
    import rich.table
    from rich.console import Console

    header, rows = grid(table)
    console = Console(width=max(130, Console().width))
    shown = rich.table.Table(title=table.title, title_justify="left")
    for heading in header:
        shown.add_column(
            heading, no_wrap=not heading, justify="right" if heading in _values(table) else "left"
        )
    for row in rows:
        shown.add_row(*row)
    console.print(shown)
    for note in table.notes:
        console.print(f"  {note}", highlight=False, markup=False)
    console.print()


def _values(table: Table) -> set[str]:
    return {column for row in table.rows for column in row.values}
