"""Studies: what is drawn on the GPU, and what is measured there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import kstest, norm, poisson

import faintspot as fs
from faintspot.estimators.brightest import BrightestPixels
from faintspot.estimators.smoothed import Smoothed
from faintspot.estimators.thresholded import Thresholded
from faintspot.estimators.total_variation import TotalVariation
from faintspot.study import Cell, StudySpecification, Sweep
from faintspot.study.cell import measure_cell
from faintspot.study.cell import realisations as drawn_on_cpu
from faintspot.study.simple_denoisers import BrightestAsTheyAre, MedianFiltered
from faintspot.study.tables import Block, HostTables

pytest.importorskip("numba_cuda", reason="needs the extra gpu")
from numba import cuda, float64, uint64

from faintspot.cuda.compiling import kernel
from faintspot.cuda.philox import normal, philox
from faintspot.cuda.poisson import poisson as poisson_number

SIDE = 5
CELL = Cell(60.0, 1.0, "diffraction", 1.0, 1.0, SIDE, 1.0, 0.0, 1.0)
SPECIFICATION = StudySpecification(
    "small",
    [Sweep("a", flux_e=300, read_noise_e=1, pixels=4)],
    realisations=20,
    arms=["brightest", "weighted"],
    weight_widths=[1.5],
    fixed_k=[3],
    device="cuda",
)
SIGNIFICANT = 1e-6  # the draws do not change: no test fails by chance from run to run


def numbers(count: int, mean: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return Poisson numbers and standard normal ones, of a counter each."""

    @kernel
    def fill(mean: Any, electrons: Any, noise: Any) -> None:
        for i in range(cuda.threadIdx.x, electrons.shape[0], 32):
            pixel, zero = uint64(i), uint64(0)
            electrons[i] = poisson_number(mean, pixel, zero, zero, uint64(5), uint64(6))
            a, b, _, _ = philox(pixel, zero, zero, uint64(3), uint64(5), uint64(6))
            noise[i] = float64(normal(a, b))

    electrons, noise = cuda.to_device(np.zeros(count)), cuda.to_device(np.zeros(count))
    fill[1, 32](mean, electrons, noise)
    return electrons.copy_to_host(), noise.copy_to_host()


def test_philox_known_answers() -> None:
    """The test vectors that the generator's authors publish."""

    @kernel
    def answer(counters: Any, words: Any) -> None:
        i = cuda.threadIdx.x
        c = counters[i]
        found = philox(c[0], c[1], c[2], c[3], c[4], c[5])
        for j in range(4):
            words[i, j] = uint64(found[j])

    whole = 0xFFFFFFFF
    digits_of_pi = (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344, 0xA4093822, 0x299F31D0)
    counters = cuda.to_device(np.array([[0] * 6, [whole] * 6, digits_of_pi], np.uint64))
    words = cuda.to_device(np.zeros((3, 4), np.uint64))
    answer[1, 3](counters, words)
    assert words.copy_to_host().tolist() == [
        [0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8],
        [0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD],
        [0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1],
    ]


@pytest.mark.parametrize("mean", [0.0, 0.3, 9.9, 300.0])
def test_poisson_and_normal_numbers(mean: float) -> None:
    count = 1000
    electrons, noise = numbers(count, mean)
    if mean == 0.0:
        assert not electrons.any()
        assert kstest(noise, norm.cdf).pvalue > SIGNIFICANT
        return
    assert np.array_equal(electrons, np.rint(electrons))
    edges = np.unique(poisson.ppf(np.linspace(0.02, 0.98, 13), mean))
    found = np.bincount(np.searchsorted(edges, electrons), minlength=len(edges) + 1)
    expected = count * np.diff(np.concatenate([[0.0], poisson.cdf(edges, mean), [1.0]]))
    chi_squared = np.sum((found - expected) ** 2 / np.maximum(expected, 1e-9))
    assert chi_squared < len(edges) + 8.0 * np.sqrt(len(edges))
    assert abs(electrons.mean() - mean) < 5 * np.sqrt(mean / count)
    assert abs(electrons.var() / mean - 1) < 5 * np.sqrt((2 + 1 / mean) / count)


def test_drawn_images() -> None:
    """Position, light of every pixel and its noise, from each image's own true position."""
    from faintspot.study.on_device import realisations

    cell = replace(CELL, flux_e=200.0, profile="gaussian", elongation=1.5, background_e=2.0, size=1.2)
    count = 60
    ((images, truth),) = realisations(cell, 1, 0, count)
    assert np.all(np.abs(truth) <= 1.0)
    assert kstest(truth.ravel(), "uniform", (-1.0, 2.0)).pvalue > SIGNIFICANT
    spot: dict[str, Any] = {"shape": (SIDE, SIDE), "profile": "gaussian", "size": 1.2, "elongation": 1.5}
    whole = 200.0 / fs.simulate.spots([[0.0, 0.0]], **spot).sum()
    mean = fs.simulate.spots(truth, flux_e=whole, **spot)
    deviation = (images - mean) / np.sqrt(mean + 2.0 + 1.0)
    assert abs(deviation.mean()) < 5 / np.sqrt(deviation.size)
    assert abs(deviation.var() - 1) < 5 * np.sqrt(2.5 / deviation.size)
    of_pixels = deviation.mean(axis=0) * np.sqrt(count)
    assert np.abs(of_pixels).max() < 5
    correlation = np.corrcoef(deviation.reshape(count, -1).T)
    assert np.abs(correlation - np.eye(SIDE**2)).max() < 6 / np.sqrt(count)


def test_an_image_does_not_depend_on_which_others_are_drawn() -> None:
    from faintspot.study.on_device import realisations

    ((whole, truth),) = realisations(CELL, 1, 0, 6)
    ((part, part_truth),) = realisations(CELL, 1, 2, 3)
    assert np.array_equal(part, whole[2:5])
    assert np.array_equal(part_truth, truth[2:5])
    ((other, _),) = realisations(CELL, 2, 0, 6)
    assert not np.any(other == whole)


def test_profile_tables() -> None:
    """The mean light by interpolation: within 1e-4 of the peak, all that studies need."""
    from faintspot.cuda.drawing import profile_tables

    for size, elongation in ((0.05, 1.0), (0.6, 3.0), (1.0, 1.0), (8.0, 1.0)):
        tables, per_px = profile_tables(SIDE, 1.0, 1.0, "diffraction", size, elongation)
        spot: dict[str, Any] = {"size": size, "elongation": elongation}
        whole = 1 / fs.simulate.spots([[0.0, 0.0]], shape=(SIDE, SIDE), **spot).sum()
        x = (np.arange(9) + 0.37) * 0.3
        peak = whole * fs.simulate.spots([[0.0, 0.0]], shape=(1, 1), **spot).sum()
        expected = whole * fs.simulate.spots(np.stack([x, 0 * x], 1), shape=(1, 1), **spot).ravel()
        place = x * per_px[0]
        cell = place.astype(int)
        nodes = np.array([-1.0, 0.0, 1.0, 2.0])
        pieces = [np.polyfit(nodes, tables[0, i : i + 4], 3) for i in cell]
        cubic = [np.polyval(piece, t) for piece, t in zip(pieces, place - cell, strict=True)]
        assert np.abs(np.array(cubic) * tables[1, 1] - expected).max() < 1e-4 * peak


ARMS: list[Any] = [
    BrightestPixels(),
    BrightestAsTheyAre(),
    MedianFiltered(),
    Smoothed(smoothing_px=0.8),
    TotalVariation(noise_std=1.8),
]


@pytest.mark.parametrize("estimator", ARMS, ids=lambda each: each.name)
def test_same_images_give_the_same_tables(estimator: Any) -> None:
    """Within rounding: single precision on the GPU, single and double on the CPU."""
    from faintspot.study.on_device import DeviceTables, brought

    cell = replace(CELL, pixels=4)
    (block,) = drawn_on_cpu(cell, 2, np.random.default_rng(4))
    block.images[1] = np.rint(block.images[1])  # ties
    host, device = HostTables(0.9), DeviceTables(0.9)
    there = brought(block)
    scored = host.scored(estimator, block, [4, 11])
    for found, known in zip(device.scored(estimator, there, [4, 11]), scored, strict=True):
        assert found.shape == known.shape
        assert found.dtype == known.dtype
        assert np.allclose(found, known, rtol=1e-5, atol=1e-5)
    if isinstance(estimator, BrightestPixels):
        sums, moments = device.sums([estimator], there, moments=True)
        expected_sums, expected_moments = host.sums([estimator], block, moments=True)
        assert moments is not None
        assert expected_moments is not None
        assert np.allclose(sums, expected_sums, rtol=1e-5, atol=1e-5)
        assert np.allclose(moments, expected_moments, rtol=1e-5, atol=1e-5)


def test_thresholded_is_measured_as_on_the_cpu() -> None:
    from faintspot.study.on_device import DeviceTables, brought

    (block,) = drawn_on_cpu(CELL, 2, np.random.default_rng(4))
    estimator = Thresholded(threshold_e=1.5)
    slopes = fs.estimators.measure(block.images, estimator)
    scored = DeviceTables().scored(estimator, brought(block), [0])
    assert np.allclose(scored.positions[:, 0], np.stack([slopes.x, slopes.y], axis=-1), atol=1e-5)
    assert np.array_equal(scored.valid[:, 0], slopes.valid)


def test_arms_without_a_kernel_here_are_measured_on_the_cpu() -> None:
    from faintspot.study.on_device import DeviceTables, brought

    class Doubled(BrightestPixels):
        def denoised(self, images: Any) -> Any:
            return 2 * images

    (block,) = drawn_on_cpu(CELL, 2, np.random.default_rng(4))
    device = DeviceTables(0.9)
    assert device.takes(Doubled)
    for found, known in zip(
        device.scored(Doubled(), brought(block), [3]),
        HostTables(0.9).scored(Doubled(), block, [3]),
        strict=True,
    ):
        assert np.array_equal(found, known)


def test_no_light_is_not_valid() -> None:
    from faintspot.study.on_device import DeviceTables, brought

    dark = Block(np.zeros((2, SIDE, SIDE), np.float32), np.zeros((2, 2)))
    for estimator in (BrightestPixels(), Thresholded(threshold_e=1.0)):
        scored = DeviceTables(1.0).scored(estimator, brought(dark), [0])
        assert not scored.valid.any()
        assert not scored.positions.any()


def test_a_whole_study(tmp_path: Path) -> None:
    """Files as of a study on the CPU, the device on record; estimators on the CPU see the same images."""
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("zarr")
    from faintspot.study import open_study, run

    results = run(SPECIFICATION, tmp_path / "s.zarr", workers=0)
    assert 'device = "cuda"' in results.attrs["specification"]
    assert results.attrs["fingerprint"] != replace(SPECIFICATION, device="cpu").fingerprint
    xarray.testing.assert_identical(results, open_study(tmp_path / "s.zarr"))
    assert np.all(results["error"] < 0.5)
    assert np.all(results["error_covariance"].values[0, 0] != 0)


def test_images_that_only_the_cpu_draws() -> None:
    """The same seed draws the same images, so that the results differ by rounding alone."""
    from faintspot.study.on_device import draws

    assert draws(CELL)
    assert not draws(replace(CELL, d_over_r0=1.0))
    sweep = Sweep("a", flux_e=300, pixels=4, em_gain=50.0)
    there = replace(SPECIFICATION, sweeps=[sweep], arms=["thresholded"], thresholds=[0.0, 1.0])
    cell = there.cells()[0]
    assert not draws(cell)
    found, expected = measure_cell(cell, there), measure_cell(cell, replace(there, device="cpu"))
    for name, value in expected.items():
        if not name.startswith("stated"):  # the GPU's tables state no standard errors
            assert np.allclose(found[name], value, rtol=1e-4, atol=1e-5, equal_nan=True), name
