"""Every public name has an example in its docstring, and the examples say what happens."""

import ast
import doctest
import importlib
import inspect
import re
from pathlib import Path
from typing import Any

import pytest

import faintspot
from faintspot.slopes.estimators import estimators, registry

PAGES = Path(__file__).resolve().parents[1] / "docs/reference/modules"
PACKAGES = [
    "faintspot",
    *(
        ".".join(("faintspot", *page.relative_to(PAGES).with_suffix("").parts))
        for page in sorted(PAGES.rglob("*.md"))
    ),
]
WITHOUT_EXAMPLE = {
    "faintspot.SubapertureFlag": "in that of Slopes",
    "faintspot.Wavefront": "in that of fit_wavefront",
    "faintspot.loop.simulation.LoopRecord": "in that of simulate_loop",
    "faintspot.loop.control.PredictiveControl": "in that of learn",
    "faintspot.loop.control.Recording": "in that of learn",
    "faintspot.experiments.Answer": "in that of tune",
    "faintspot.io.StoredSlopes": "in that of read_slopes",
    "faintspot.slopes.training.CentroidGain": "in that of measure_centroid_gain",
    "faintspot.slopes.training.SodiumFit": "in that of fit_sodium_profile",
    "faintspot.slopes.training.LearntPSF": "in that of learn_psf_from_images",
    "faintspot.slopes.wavefront.Certificate": "in that of certify",
    "faintspot.slopes.wavefront.Drift": "in that of fit_drift",
    "faintspot.slopes.wavefront.Discrepancy": "in that of slope_discrepancy",
    "faintspot.slopes.estimators.Sensor": "made by a pipeline, in that of Estimator",
}
NEEDED = {"simulate_loop": ("hcipy",), "run": ("xarray",), "open_study": ("xarray", "zarr")}
"""Packages of extras that examples need."""


def public_names() -> dict[str, Any]:
    """Return all classes and functions that the reference shows, by where they are shown first."""
    found: dict[int, tuple[str, Any]] = {}
    for package in PACKAGES:
        module = importlib.import_module(package)
        for name in getattr(module, "__all__", dir(module)):
            item = getattr(module, name)
            documented = inspect.isclass(item) or inspect.isfunction(item)
            if documented and not name.startswith("_") and item.__module__.startswith("faintspot"):
                found.setdefault(id(item), (f"{package}.{name}", item))
    return dict(found.values())


NAMES = public_names()


def test_public_names_have_examples() -> None:
    assert len(NAMES) > 80
    without = {name for name, item in NAMES.items() if ">>>" not in (inspect.getdoc(item) or "")}
    assert without == set(WITHOUT_EXAMPLE)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(NAMES.keys() - WITHOUT_EXAMPLE.keys()))
def test_examples_give_what_they_show(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    home, _, short = name.rpartition(".")
    for package in NEEDED.get(short, ()):
        pytest.importorskip(package)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(registry, "_kinds", estimators())  # a copy: an example registers one of its own
    item = getattr(importlib.import_module(home), short)
    said: list[str] = []
    runner = doctest.DocTestRunner()
    found = doctest.DocTestFinder().find(item, name)
    assert any(each.examples for each in found)
    for each in found:
        runner.run(each, out=said.append)
    assert not runner.failures, "".join(said)


def test_packages_name_modules_that_exist() -> None:
    """The reading order in the docstring of a package."""
    unknown = []
    for path in Path(faintspot.__file__).parent.rglob("__init__.py"):
        order = (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").partition(
            "Read in this order"
        )
        unknown += [
            f"{path.parent.name}: {name}"
            for name in re.findall(r"`([a-z_]+)`", order[2])
            if not (path.with_name(f"{name}.py").exists() or path.with_name(name).is_dir())
        ]
    assert unknown == []


OF_OTHERS = {
    "with",
    "ShackHartmannWavefrontSensorEstimator",
    "ShSlopec",
    "Modalrec",
    "out_slopes",
}
"""Names in docstrings that are Python's, or those of tools that adapters serve."""


@pytest.mark.slow
def test_names_in_docstrings_exist() -> None:
    """Between single backquotes: modules, and what some module defines, takes or uses."""
    root, modules, names, cited = Path(faintspot.__file__).parent, set[str](), set(OF_OTHERS), []
    for path in root.rglob("*.py"):
        parts = path.relative_to(root).with_suffix("").parts
        modules |= {".".join(parts[i:]) for i in range(len(parts))}
        modules |= {".".join(parts[i:-1]) for i in range(len(parts) - 1)}
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names |= {str(getattr(node, field, None)) for field in ("name", "id", "attr", "arg")}
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                if re.fullmatch(r"[\w.]+", node.value):
                    names.add(node.value)
                words = re.findall(r"(?<!`)`([A-Za-z_][\w.]*)`(?!`)", node.value)
                cited += [(path.relative_to(root).as_posix(), word) for word in words]
    packages = {path.name for path in root.iterdir() if path.is_dir()}

    def exists(word: str) -> bool:
        owner, _, last = word.removeprefix("faintspot.").rpartition(".")
        if owner.split(".")[0] in packages and not re.search("[A-Z]", owner):
            return f"{owner}.{last}" in modules or (owner in modules and last in names)
        return word in modules or (last in names and (not owner or owner in modules | names or exists(owner)))

    files = {path.name for path in root.rglob("*") if path.suffix in (".toml", ".npz", ".c", ".h")}
    unknown = [f"{where}: {word}" for where, word in cited if not (exists(word) or word in files)]
    assert "\n".join(unknown) == ""


def test_files_of_the_journeys_exist() -> None:
    """In CONTRIBUTING: from a frame to a command, from a recording to a filter."""
    root = Path(faintspot.__file__).parent
    text = (Path(__file__).parents[1] / "CONTRIBUTING.md").read_text(encoding="utf-8")
    files = re.findall(r"(?m)^\| `([\w/]+\.py)` \|", text)
    assert len(files) > 15
    assert [file for file in files if not (root / file).is_file()] == []
