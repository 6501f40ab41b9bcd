"""Specifications: what they list, and one line for what is wrong with them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.refusals import refused

from faintspot.experiments import Cell, StudySpecification, Sweep

TEXT = """
name = "mine"
seed = 7
realisations = 400
estimators = ["brightest", "tv"]
fixed_k = [10]

[options]
noise_std = [0.5, 1.0]

[sweeps.signal]
flux_e = { from = 10, to = 1000, points = 3, spacing = "log" }
read_noise_e = [0.1, 3]

[sweeps.size]
flux_e = 100
size = { from = 1, to = 2, points = 3 }
profile = ["diffraction", "gaussian"]
"""


def test_a_text_gives_the_specification() -> None:
    specification = StudySpecification.from_text(TEXT)
    assert (specification.name, specification.seed, specification.realisations) == ("mine", 7, 400)
    assert specification.modes == ("best", "fixed10")
    assert specification.options["noise_std"] == (0.5, 1.0)
    signal, size = specification.sweeps
    assert signal.flux_e == (10.0, 100.0, 1000.0)
    assert signal.read_noise_e == (0.1, 3.0)
    assert size.size == (1.0, 1.5, 2.0)
    assert size.profile == ("diffraction", "gaussian")
    # 3 x 2 and 3 x 2, of which 100 e-, 0.1 e-, diffraction, size 1 is in both.
    cells = specification.cells()
    assert len(cells) == 11
    assert len(set(cells)) == 11
    assert cells[0] == Cell(10.0, 0.1, "diffraction", 1.0, 1.0, 16, 1.0, 0.0, 1.0)
    assert specification.largest_k == 255


def test_text_and_back(tmp_path: Path) -> None:
    specification = StudySpecification.from_text(TEXT)
    again = StudySpecification.from_text(specification.to_text())
    assert again == specification
    assert again.fingerprint == specification.fingerprint
    path = tmp_path / "mine.toml"
    path.write_text(TEXT)
    assert StudySpecification.from_file(path) == specification


def test_fingerprint_changes_with_everything() -> None:
    base = StudySpecification("a", [Sweep("one")])
    changes: dict[str, Any] = {
        "seed": 2,
        "realisations": 100,
        "estimators": ["brightest", "tv"],
        "options": {"noise_std": [0.5]},
        "fixed_k": [],
        "corrected": True,
        "search_range_px": 3,
        "sweeps": [Sweep("one", flux_e=[1, 2])],
    }
    others = [replace(base, **{name: value}).fingerprint for name, value in changes.items()]
    assert len({base.fingerprint, *others}) == len(changes) + 1


def test_seeds_depend_on_study_and_coordinates_alone() -> None:
    """Those without turbulence are of the first version, so that studies are repeated to the last digit."""
    few = Sweep("few", flux_e=[10, 20]).cells()
    many = Sweep("many", flux_e=[5, 20.0, 10], pixels=[8, 16]).cells()
    states = {cell: tuple(cell.seed(1).generate_state(4)) for cell in many}
    assert len(set(states.values())) == 6
    for cell in few:
        assert tuple(cell.seed(1).generate_state(4)) == states[cell]
        assert tuple(cell.seed(2).generate_state(4)) != states[cell]
    turbulent = Sweep("a", d_over_r0=[0.0, 1.0]).cells()
    plain, speckled = (cell.seed(1).generate_state(2).tolist() for cell in turbulent)
    assert plain == [205420210, 2240507304] != speckled


def test_search_range_is_the_same_for_all_methods() -> None:
    sweep = Sweep("a", position_range_px=[1, 4])
    near, far = sweep.cells()
    old = StudySpecification("x", [sweep])
    assert old.search_range_of(far) == np.inf
    new = replace(old, estimators=["brightest", "ml"])
    assert (new.search_range_of(near), new.search_range_of(far)) == (1.0, 4.0)
    assert replace(new, search_range_px=2).search_range_of(far) == 2.0


def test_modes_follow_the_cells() -> None:
    sweep = Sweep("a", pixels=[4, 16], d_over_r0=[0, 2])
    specification = StudySpecification(
        "x", [sweep], fixed_k=[20], corrected=True, options={"blur_px": [0.0, 1.0]}
    )
    assert specification.modes == ("best", "fixed20", "corrected")
    still, _, still_large, _ = sweep.cells()
    assert specification.kept_pixels(still) == {"best": None, "corrected": None}
    assert specification.kept_pixels(still_large) == {"best": None, "fixed20": 20, "corrected": None}


def test_noise_of_a_mean_pixel() -> None:
    plain = Cell(256.0, 3.0, "diffraction", 1.0, 1.0, 16, 1.0, 2.0, 1.0)
    assert plain.pixel_noise_e == pytest.approx(np.sqrt(9.0 + 1.0 + 2.0))
    multiplied = replace(plain, em_gain=100.0)
    assert multiplied.pixel_noise_e == pytest.approx(np.sqrt(9.0 + 2.0 * 3.0))


SWEEP = "\n[sweeps.a]\nflux_e = 100\n"
BAD = {
    "name = 1" + SWEEP: ("name", "text"),
    SWEEP: ("name", "none"),
    'name = "x"': ("sweeps", "none"),
    'name = "x"\nsweeps = 3': ("sweeps", "[sweeps.signal]"),
    'name = "x"\nrealizations = 3' + SWEEP: ("realizations", "did you mean realisations"),
    'name = "x"\nrealisations = 3' + SWEEP: ("realisations = 3", "20"),
    'name = "x"\nestimators = ["brightest", "tvs"]' + SWEEP: ("estimators = 'tvs'", "'tv'"),
    'name = "x"\nestimators = []' + SWEEP: ("estimators", "empty"),
    'name = "x"\noptions.noise_std = [0]' + SWEEP: ("options.noise_std = 0", "above 0"),
    'name = "x"\noptions.noise_std = 1.0' + SWEEP: ("options.noise_std", "list"),
    'name = "x"\noptions.noise_std = []' + SWEEP: ("options.noise_std", "empty"),
    'name = "x"\noptions.strength = [1.0]' + SWEEP: ("options.strength", "noise_std"),
    'name = "x"\nfixed_k = [20, 256]' + SWEEP: ("fixed_k = 256", "256 pixels"),
    'name = "x"\nfixed_k = [2.5]' + SWEEP: ("fixed_k = 2.5", "whole"),
    'name = "x"\n[sweeps.a]\nfluxe = 3': ("sweeps.a.fluxe", "did you mean flux_e"),
    'name = "x"\n[sweeps.a]\nflux_e = []': ("flux_e", "empty"),
    'name = "x"\n[sweeps.a]\nflux_e = 0': ("flux_e = 0", "above 0"),
    'name = "x"\n[sweeps.a]\nflux_e = "many"': ("flux_e", "real numbers"),
    'name = "x"\n[sweeps.a]\nflux_e = nan': ("flux_e", "NaN"),
    'name = "x"\n[sweeps.a]\nread_noise_e = [0.1, -3]': ("'a'", "read_noise_e = -3"),
    'name = "x"\n[sweeps.a]\nelongation = 0.5': ("elongation = 0.5",),
    'name = "x"\n[sweeps.a]\npixels = 8.5': ("pixels = 8.5", "whole"),
    'name = "x"\n[sweeps.a]\npixels = 2': ("pixels = 2",),
    'name = "x"\n[sweeps.a]\nprofile = "airy"': ("profile = 'airy'", "'gaussian'"),
    'name = "x"\n[sweeps.a]\nflux_e = { from = 100, to = 10, points = 5 }': ("empty range 100 to 10",),
    'name = "x"\n[sweeps.a]\nflux_e = { from = 10, to = 100 }': ("flux_e.points", "none"),
    'name = "x"\n[sweeps.a]\nflux_e = { from = 10, to = 100, point = 3 }': ("did you mean points",),
    'name = "x"\n[sweeps.a]\nread_noise_e = { from = 0, to = 1, points = 3, spacing = "log" }': ("from = 0",),
    'name = "x"\n[sweeps.a]\nd_over_r0 = 2\nelongation = [1, 2]': ("d_over_r0 = 2", "elongation 1"),
    'name = "x"\n[sweeps.a]\nd_over_r0 = 2\nprofile = "gaussian"': ("d_over_r0 = 2", "'diffraction'"),
    'name = "x': ("not a TOML file",),
}


def test_bad_specifications_get_one_line() -> None:
    for text, words in BAD.items():
        with refused("bad.toml: ", *words):
            StudySpecification.from_text(text, "bad.toml")


def test_specifications_without_sweeps_are_refused() -> None:
    with refused("sweeps", "'a' 2 times"):
        StudySpecification("x", [Sweep("a"), Sweep("a")])
    with refused("sweeps", "[]"):
        StudySpecification("x", [])
    with refused("no such file"):
        StudySpecification.from_file("nothing-here.toml")
    # Windows too small for a fixed k are allowed beside one that is large enough.
    StudySpecification("x", [Sweep("a", pixels=[4, 16])])
    with refused("fixed_k = 20"):
        StudySpecification("x", [Sweep("a", pixels=4)])
