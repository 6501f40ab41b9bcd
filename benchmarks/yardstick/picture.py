"""Picture of the stored table: `python -m benchmarks.yardstick.picture docs/results/data/yardstick.json`."""

import json
import sys
from pathlib import Path

from faintspot.base.report.plots import new_figure

MARKERS = "os^D"


def draw(path: Path) -> Path:
    """Draw the photon efficiency of every candidate for spots of each origin, the best on top."""
    table = json.loads(path.read_text(encoding="utf-8"))["tables"]["yardstick"]
    origins = table["columns"][1 : len(MARKERS) + 1]
    found = {
        row[0].replace("`", ""): [float(cell.split(" ")[0]) for cell in row[1 : len(origins) + 1]]
        for row in table["rows"]
        if row[1]
    }
    names = sorted(found, key=lambda name: sum(found[name]))
    figure = new_figure(7.5, 0.32 * len(names) + 1.2)
    axes = figure.subplots()
    for place, (origin, marker) in enumerate(zip(origins, MARKERS, strict=True)):
        axes.plot([found[name][place] for name in names], range(len(names)), marker, label=f"spots: {origin}")
    axes.set(yticks=range(len(names)), yticklabels=names, xlim=(0, 1))
    axes.set_xlabel("photon efficiency, 1: Cramer-Rao bound")
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left", frameon=False)
    picture = path.parents[1] / f"{path.stem}.png"
    figure.savefig(picture, dpi=110)
    return picture


if __name__ == "__main__":
    print(draw(Path(sys.argv[1])))
