"""Python in README and docs runs, with what its page takes for granted; figures are those stored."""

import json
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterable
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import faintspot as fs
from faintspot.engine.telemetry.recorder import TelemetryStore
from faintspot.engine.telemetry.ring import image_type, layout_values, record_type
from faintspot.io import read_telemetry, write_aot
from faintspot.slopes.estimators import estimators, registry
from faintspot.slopes.simulate import sensor_frames

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("", "adapters", "guide", "reference", "results")
PAGES = [
    ROOT / "README.md",
    *(page for folder in FOLDERS for page in sorted((ROOT / "docs" / folder).glob("*.md"))),
]
BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)

NOT_RUN = {
    "import hcipy": "run by the adapter's own tests",
    "adapter.calibrating": "a sketch of what adapters share",
    "import oopao": "run by tests/adapters/test_manual.py",
    "import soapy": "run by tests/adapters/test_manual.py",
    "import specula": "run by tests/adapters/test_manual.py",
    "from pyrtc import": "run by tests/adapters/test_manual.py",
    "simulate_loop(": "the tutorial on loops runs it",
    "wfs.valid_subapertures": "needs a loop of OOPAO",
    "fs.control.Recording(": "needs a recorded loop",
    "command_of_slopes": "run by the tests of exported matrices",
    "command_of_surprise": "run by the tests of exported matrices",
    "open_study(": "needs a study's results",
    "PixelRing.create": "needs a camera",
    "pyshmem.open": "needs a running engine",
    "dask_jobqueue": "needs a batch system",
}
"""What marks a block that is not run here, and why."""
FRAMES = 200
SHORTER = {
    "np.arange(1000)": f"np.arange({FRAMES})",
    "flux_e=[30, 100, 300])])": "flux_e=[30, 100])], realisations=200)",
    'budget="0.1"))': 'budget="0.1"), realisations=256)',
    "realisations=512": "realisations=256",
}
"""What stands in a page, and what is run instead."""


def blocks() -> list[Any]:
    """Return all blocks, page by page; those of a page share their names."""
    return [
        pytest.param(page, id=str(page.relative_to(ROOT)))
        for page in PAGES
        if BLOCK.search(page.read_text(encoding="utf-8"))
    ]


@pytest.fixture(scope="module")
def assumed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """What pages take for granted: a folder with slopes a recorded night, a sensor and its frames."""
    folder = tmp_path_factory.mktemp("pages")
    shutil.copytree(ROOT / "examples", folder / "examples")
    rng = np.random.default_rng(1)
    layout = fs.Layout.grid((7, 7), pixels=16, outer_radius=3.5, inner_radius=0.5)
    calibration = fs.Calibration(dark=100.0, gain_e_per_adu=2.0, read_noise_e=3.0)
    dithered = 0.2 * np.sin(2 * np.pi * np.arange(FRAMES) * 0.13)[:, None, None]
    moved = dithered + rng.uniform(-0.3, 0.3, (FRAMES, len(layout), 2))
    electrons, truth = sensor_frames(layout, FRAMES, flux_e=400.0, positions=moved, rng=rng)
    frames = electrons / 2.0 + 100.0
    images, positions = fs.slopes.simulate.subapertures(500, flux_e=40.0, rng=rng)
    settings = fs.Settings("window", flux_e=400.0, spot_fwhm_px=1.8)
    pipeline = fs.SlopePipeline(layout, settings, calibration)
    slopes = pipeline(frames)
    for ending in ("npz", "fits", "zarr"):
        write_slopes(folder / f"slopes.{ending}", frames[:20], layout, calibration)
    write_night(folder / "night", layout)
    return folder, {
        "fs": fs,
        "np": np,
        "layout": layout,
        "calibration": calibration,
        "frames": frames,
        "images": images,
        "positions": positions,
        "truth": truth,
        "settings": settings,
        "pipeline": pipeline,
        "slopes": slopes,
        "n": len(layout),
    }


@pytest.fixture
def names(
    assumed: tuple[Path, dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> dict[str, Any]:
    """A page's own copy of it."""
    monkeypatch.chdir(shutil.copytree(assumed[0], tmp_path / "page"))
    monkeypatch.setattr(registry, "_kinds", estimators())  # a copy: a page registers an estimator of its own
    return {
        name: value.copy() if isinstance(value, np.ndarray) else value for name, value in assumed[1].items()
    }


def write_slopes(path: Path, frames: Any, layout: fs.Layout, calibration: fs.Calibration) -> None:
    """Measure frames into a file, as `faintspot slopes` does."""
    from faintspot.slopes.recorded.measuring import measure_recorded

    toml = path.parent / "faintspot.toml"
    if not toml.exists():
        for item in (layout, calibration, fs.Settings("brightest")):
            item.save(toml)
    np.save(path.parent / "frames.npy", frames)
    measure_recorded([path.parent / "frames.npy"], toml, path)


def write_night(path: Path, layout: fs.Layout) -> None:
    """Write telemetry of 20 frames with two methods in turn, in both formats."""
    records = np.zeros(20, record_type(len(layout)))
    records["frame"] = np.arange(20)
    records["method"] = records["frame"] % 2
    kinds = record_type(len(layout)), image_type(layout.frame_shape, len(layout), layout.window)
    told = {
        "name": "night",
        "layout": layout_values(layout),
        "settings": "",
        "methods": ["none", "tv"],
        "dropped_records": 0,
    }
    store = TelemetryStore(path.with_suffix(".zarr"), *kinds, told)
    store.append(records, np.zeros(1, kinds[1]), {"changes": []})
    write_aot(path.with_suffix(".fits"), read_telemetry(store.path))


@pytest.mark.slow
@pytest.mark.parametrize("page", blocks())
def test_blocks_of_pages_run(page: Path, names: dict[str, Any]) -> None:
    text = page.read_text(encoding="utf-8")
    for length, shorter in SHORTER.items():
        text = text.replace(length, shorter)
    for number, code in enumerate(BLOCK.findall(text)):
        compiled = compile(code, f"{page.name}, block {number}", "exec")  # also what is not run is Python
        if not any(mark in code for mark in NOT_RUN):
            exec(compiled, names)


@pytest.mark.slow
def test_names_are_there_after_the_import() -> None:
    """Blocks share a process with others that import more than they do."""
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    assert [length for length in SHORTER if length not in text] == []
    names = sorted(set(re.findall(r"\bfs\.([A-Za-z]\w*)", text)))
    code = "import faintspot, sys; print([name for name in sys.argv[1:] if not hasattr(faintspot, name)])"
    done = subprocess.run([sys.executable, "-c", code, *names], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_package_page_links_to_no_file() -> None:
    """The page of a package index has no file beside the README."""
    hooks = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["hatch"]["metadata"][
        "hooks"
    ]
    page = (ROOT / "README.md").read_text(encoding="utf-8")
    for substitution in hooks["fancy-pypi-readme"]["substitutions"]:
        page = re.sub(substitution["pattern"], substitution["replacement"], page)
    assert "docs/start.md" in page
    assert re.findall(r"\]\((?!https://)[^)]*\)", page) == []
    assert "A noisy frame" not in page
    assert "200 electrons a spot" not in page  # what the picture shows


RESULTS = ROOT / "docs" / "results"
DATA = {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in (RESULTS / "data").glob("*.json")}
MEASURED = {name for name, data in DATA.items() if data["tables"]}
NUMBER = r"(?<![\d.])\d+\.\d{1,4}(?!\.?\d)(?: ± \d+\.\d+)?"
FIGURE = re.compile(rf"{NUMBER}(?: to {NUMBER})?(?: %)?|\d+(?: to \d+)? %")
"""What was measured: a decimal fraction with its error or range, or a percentage."""
TAKEN = re.compile(r"\{\{ *(\w+)\.(\w+) *\}\}")
NO_FIGURE = re.compile(r"```.*?^```|`[^`]*`|\]\([^)]*\)|https?://\S+|\{\{.*?\}\}", re.DOTALL | re.MULTILINE)


def figures(text: str) -> set[str]:
    """Return the figures that a text states, code and addresses left out."""
    return set(FIGURE.findall(re.sub(r"\s+", " ", NO_FIGURE.sub(" ", text))))


def unknown_figures(text: str, names: Iterable[str], *parts: str) -> set[str]:
    """Return the figures of a text that stored results do not have, or not in some of their parts."""
    kept = json.dumps(
        [[DATA[name][part] for part in parts or DATA[name]] for name in names], ensure_ascii=False
    )
    return {figure for figure in figures(text) if not states(kept, figure)}


def states(text: str, figure: str) -> bool:
    """Return whether a text has a figure as it stands."""
    return re.search(rf"(?<![\d.]){re.escape(figure)}(?![\d]|\.\d)", text) is not None


def blocks_of_text(text: str) -> list[str]:
    """Return the paragraphs, each with the table that follows it."""
    return re.split(r"\n\s*\n(?!\|)|\n(?=- )", text)


def test_pages_take_only_figures_that_are_stored() -> None:
    stored_keys = {
        (name, key)
        for name, data in DATA.items()
        for key in ("question", "answer", *data.get("figures", ()), *data["tables"])
    }
    assert {taken for page in PAGES for taken in TAKEN.findall(page.read_text("utf-8"))} <= stored_keys


def test_pages_of_results_name_no_figure_that_the_data_do_not_have() -> None:
    texts = {page.stem: page.read_text("utf-8") for page in RESULTS.glob("*.md")}
    unknown = {
        page: unknown_figures(text, {name for name, _ in TAKEN.findall(text)}) for page, text in texts.items()
    }
    assert not any(unknown.values()), unknown


def test_a_paragraph_with_a_link_to_results_names_only_their_figures() -> None:
    unknown = {}
    for block in (block for page in PAGES for block in blocks_of_text(page.read_text("utf-8"))):
        names = {*re.findall(r"results/(\w+)\.md", block), *(name for name, _ in TAKEN.findall(block))}
        if names & MEASURED and (found := unknown_figures(block, names & MEASURED)):
            unknown[block[:60]] = found
    assert unknown == {}


def test_each_row_of_the_readme_is_one_of_a_stored_table() -> None:
    """A figure beside a wrong name would not be noticed otherwise."""
    rows = [" ".join(row) for row in DATA["foreign_loops"]["tables"]["loops"]["rows"]]
    lines = [line for line in (ROOT / "README.md").read_text(encoding="utf-8").splitlines() if "**0." in line]
    assert len(lines) > 4
    for line in lines:
        assert any(all(states(row, figure) for figure in figures(line)) for row in rows), line


def test_the_readme_names_headline_figures_only() -> None:
    text = re.sub(
        r"^```.*?^```", "", (ROOT / "README.md").read_text(encoding="utf-8"), flags=re.DOTALL | re.M
    )
    answered = {name for name, data in DATA.items() if "answer" in data}
    for block in blocks_of_text(text):
        known = set(re.findall(r"results/(\w+)\.md", block)) & MEASURED & answered or answered
        prose = "\n".join(line for line in block.splitlines() if "**0." not in line)
        assert unknown_figures(re.sub(r"Python 3\.\d+", "", prose), known, "figures", "answer") == set()


@pytest.mark.parametrize("name", sorted(DATA))
def test_an_answer_names_no_figure_that_its_tables_do_not_have(name: str) -> None:
    data = DATA[name]
    known = json.dumps([data.get(part) for part in ("figures", "tables", "notes")], ensure_ascii=False)
    assert {figure for figure in figures(data.get("answer", "")) if not states(known, figure)} == set()
    for table in data["tables"].values():
        date.fromisoformat(table["measured"])
        assert table["processor"]
        assert table["version"]
        assert {len(row) for row in table["rows"]} == {len(table["columns"])}
