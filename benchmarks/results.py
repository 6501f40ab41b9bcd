"""What a run found, as a JSON file: written after every benchmark, so that an interrupted run keeps it."""

import json
import math
import re
from dataclasses import asdict, dataclass, field
from datetime import date
from pathlib import Path
from typing import Any

from benchmarks.machine import fingerprint, short, versions
from benchmarks.measuring import Row, Table
from benchmarks.showing import grid

FOLDER = Path(__file__).with_name("results")
PAGES = Path(__file__).parents[1] / "docs" / "results" / "data"
"""What the pages of the documentation show: one file a page or benchmark."""
FORMAT = 2


class ResultsError(Exception):
    """A file that cannot be used: one line."""


@dataclass(frozen=True)
class Benchmark:
    """What one module found.

    Attributes
    ----------
    load : str
        Load average when it began.
    failure : str
        Why there are no tables; "" when it came to its end.
    """

    name: str
    seconds: float
    load: str
    tables: list[Table] = field(default_factory=list)
    failure: str = ""


@dataclass(frozen=True)
class Results:
    """A run: when (ISO 8601), on which machine, with what, and what it found so far."""

    started: str
    fingerprint: dict[str, str]
    versions: dict[str, str]
    benchmarks: list[Benchmark] = field(default_factory=list)

    @property
    def stem(self) -> str:
        """Name of its files: date, time and fingerprint."""
        return f"{self.started.replace(':', '')}-{short(self.fingerprint)}"


def write(results: Results, folder: Path) -> Path:
    """Write the JSON file in one step; return its path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{results.stem}.json"
    text = json.dumps({"format": FORMAT, **_plain(asdict(results))}, indent=1, allow_nan=False)
    unfinished = path.with_suffix(".part")
    unfinished.write_text(text + "\n", encoding="utf-8")
    unfinished.replace(path)
    return path


def read(path: Path) -> Results:
    """Read a JSON file.

    Raises
    ------
    ResultsError
        When it is not there, or not such a file.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content.pop("format") != FORMAT:
            raise ResultsError(f"{path}: of another format than {FORMAT}, that of this version")
        benchmarks = [_benchmark(item) for item in content.pop("benchmarks")]
        return Results(**content, benchmarks=benchmarks)
    except OSError as error:
        raise ResultsError(f"{path}: {error.strerror}") from None
    except (ValueError, KeyError, TypeError, AttributeError):
        raise ResultsError(f"{path}: not the results of benchmarks") from None


def publish(results: Results, benchmark: Benchmark, folder: Path = PAGES) -> Path:
    """Write the tables of a benchmark to the file that the pages take their figures from; return its path."""
    tables = {}
    for table in benchmark.tables:
        columns, rows = grid(table)
        tables[table.name.replace("-", "_")] = {
            "title": table.title,
            "columns": columns,
            "rows": rows,
            "notes": table.notes,
        }
    origin = {
        "command": f"python -m benchmarks {benchmark.name}",
        "processor": results.fingerprint["processor"],
        "version": results.versions["faintspot"],
        "measured": results.started[:10],
    }
    return publish_tables(folder / f"{benchmark.name}.json", tables, origin)


def origin_now(command: str) -> dict[str, str]:
    """Return command, processor, version and date of what is measured now."""
    return {
        "command": command,
        "processor": fingerprint()["processor"],
        "version": versions()["faintspot"],
        "measured": date.today().isoformat(),
    }


def publish_tables(path: Path, tables: dict[str, dict[str, Any]], origin: dict[str, str]) -> Path:
    """Write tables to a file of the pages, with where they come from; what else it holds stays.

    Parameters
    ----------
    path : Path
    tables : dict
        By name: title, columns, rows as text, notes. The configuration of a stored table stays.
    origin : dict
        Command, processor, version and date (measured).
    """
    data = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {"tables": {}}
    for name, table in tables.items():
        stored = data["tables"].get(name, {"configuration": f"{table['title']}:"})
        data["tables"][name] = {**stored, **origin, **table}
    text = json.dumps(data, ensure_ascii=False, indent=1)
    text = re.sub(r"\n {4,5}(?=[^ \[{}\]])", " ", text)  # a row of a table is a line
    text = re.sub(r"\n {4}\]", "]", text).replace('[ "', '["')
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"{text}\n", encoding="utf-8")
    return path


def newest_first(folder: Path) -> list[Path]:
    """Return the results of a folder."""
    return sorted(folder.glob("*.json"), key=lambda path: (path.name.rpartition("-")[0], path), reverse=True)


def _benchmark(item: dict[str, Any]) -> Benchmark:
    tables = [_table(table) for table in item.pop("tables")]
    return Benchmark(**item, tables=tables)


def _table(item: dict[str, Any]) -> Table:
    rows = [
        Row(**{**row, "values": _numbers(row["values"]), "spread": _numbers(row["spread"])})
        for row in item.pop("rows")
    ]
    return Table(**item, rows=rows)


def _numbers(values: dict[str, float | None]) -> dict[str, float]:
    return {name: math.nan if value is None else value for name, value in values.items()}


def _plain(value: Any) -> Any:
    """Return plain Python values; what is not finite, which JSON does not know, becomes null."""
    if isinstance(value, dict):
        return {str(name): _plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, str | bool | int) or value is None:
        return value
    if hasattr(value, "item"):  # a NumPy scalar
        return _plain(value.item())
    return value if math.isfinite(value) else None
