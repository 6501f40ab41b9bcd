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
