"""The figures of a study: what is drawn, and its numbers."""

import csv
import io
from typing import Any

import numpy as np
import pytest
from tests.experiments.study_cases import METHODS, cells, dataset, power_law

from faintspot.experiments.methods import label_of
from faintspot.experiments.paper.figures import (
    baselines_figure,
    kept_pixels_figure,
    sweep_figure,
    triple_images,
    triple_picture,
)
from faintspot.experiments.study.curves import kept_panels, spread


def equal(cell: Any, method: str, mode: str) -> float:
    return 1.5 if method == "tv" else 1.0


def study(**options: Any) -> Any:
    others: list[dict[str, Any]] = [{}, {"size": 2.0}, {"read_noise_e": 3.0}, {"position_range_px": 4.0}]
    others += [{"profile": "gaussian"}, {"pixels": 8}]
    return dataset([cell for each in others for cell in cells(**each)], power_law(equal), **options)


def test_sweep_is_drawn_in_both_modes_and_one_row_for_each_profile_and_range() -> None:
    data = study()
    made = sweep_figure(data, list(range(len(data["cell"]))), "fig9", "A title")
    titles = [axes.get_title() for axes in made.figure.axes]
    assert titles == [
        f"{mode}: {spots} spots, positions within ±{reach} px"
        for spots, reach in (("diffraction", 1), ("diffraction", 4), ("gaussian", 1))
        for mode in ("best k", "fixed k = 40")
    ]
    assert made.figure.axes[0].get_ylabel().endswith("(px)")
    assert "photo-electrons" in made.figure.axes[-1].get_xlabel()


def test_solid_is_tv_and_dashed_is_not() -> None:
    """The numbers of a sweep are in its data; the axis is what varies when the flux does not."""
    data = study()
    made = sweep_figure(data, list(range(5)), "fig9", "A title")
    lines = [line for line in made.figure.axes[0].lines if np.size(line.get_xdata()) == 5]
    assert [line.get_linestyle() for line in lines] == ["-", "--"]
    for line, method in zip(lines, ("tv", "brightest"), strict=True):
        wanted = data["error"].sel(estimator=method, mode="best").values[:5]
        np.testing.assert_allclose(np.asarray(line.get_ydata(), dtype=float), wanted)
    rows = list(csv.DictReader(io.StringIO(made.csv)))
    assert len(rows) == 5 * 2 * 2  # cells, methods and the modes that are drawn
    row = next(row for row in rows if row["panel"].startswith("fixed") and row["line"] == label_of("tv"))
    wanted = data["error"].isel(cell=0).sel(mode="fixed40", estimator="tv")
    assert [float(row[name]) for name in "xy"] == pytest.approx([10.0, float(wanted)], rel=1e-6)
    every = [cell for noise in (0.1, 1.0, 3.0) for cell in cells(fluxes=(100.0,), read_noise_e=noise)]
    figure = sweep_figure(dataset(every, power_law(equal)), [0, 1, 2], "noise", "Read noise").figure
    assert figure.axes[0].get_xlabel() == "read noise (e-)"


def test_kept_pixels_are_drawn_for_signals_sizes_and_noises() -> None:
    made = kept_pixels_figure(study())
    assert made is not None
    first, second, third = (axes.get_title() for axes in made.figure.axes[:3])
    assert first.startswith("signals")
    assert second.startswith("spot sizes")
    assert third.startswith("read noises")
    assert made.csv.count("\n") > 100
    assert kept_pixels_figure(study().sel(estimator=["brightest"], estimator2=["brightest"])) is None


def test_kept_panels_take_the_nearest_flux_and_the_largest_window() -> None:
    data = study()
    signals, sizes, noises = kept_panels(data, "diffraction")
    assert [label for label, _ in signals.cells] == ["80 e-", "300 e-"]
    assert [label for label, _ in sizes.cells] == ["size 1", "size 2"]
    assert [label for label, _ in noises.cells] == ["0.1 e-", "3 e-"]
    assert all(data["pixels"].values[cell] == 16 for _, cell in sizes.cells)
    assert kept_panels(data, "nothing") == []


def test_spread_is_that_of_the_curve() -> None:
    data = study()
    found = spread(data, 0, "brightest")
    assert found is not None
    assert found[0] == pytest.approx(np.log(1 + 0.5 * np.log(6) ** 2 / 3))
    assert spread(data, 0, "thresholded") is None


def test_baselines_are_drawn_for_the_main_read_noises() -> None:
    part = study(unfinished=range(5, 30))
    made, unfinished = (baselines_figure(each, "diffraction") for each in (study(), part))
    assert made is not None
    assert unfinished is not None
    assert [axes.get_title() for axes in made.figure.axes] == [
        f"{mode}: {noise} e- read noise" for noise in (0.1, 3) for mode in ("best k", "fixed k = 40")
    ]
    assert len(made.figure.axes[0].containers) == len(METHODS)
    assert len(unfinished.figure.axes) == 2
    assert baselines_figure(study(), "nothing") is None
    assert baselines_figure(part, "gaussian") is None


def test_triple_picture_shows_noise_and_its_removal() -> None:
    layout, (clean, noisy, denoised) = triple_images()
    assert clean.shape == noisy.shape == denoised.shape == (len(layout), 16, 16)
    assert np.std(denoised - clean) < 0.5 * np.std(noisy - clean)
    made = triple_picture()
    assert len([axes for axes in made.figure.axes if axes.get_title()]) == 6
