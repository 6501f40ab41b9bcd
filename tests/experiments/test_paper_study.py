"""The paper's study: its cells and its report."""

import pytest

from faintspot.base.errors import InputError
from faintspot.experiments.study.specification import FIGURES, paper_study


def test_full_study_has_every_figure_of_the_paper() -> None:
    specification = paper_study()
    names = {sweep.name.split()[0] for sweep in specification.sweeps}
    assert names == {"fig2", "fig3", "fig4", "fig5", "fig6", "fig7"}
    cells = specification.cells()
    assert {cell.read_noise_e for cell in cells} == {0.1, 0.3, 0.5, 1, 3, 5, 10, 16}
    assert {cell.pixels for cell in cells} == {8, 10, 12, 14, 16}
    assert {cell.size for cell in cells} == {1, 1.5, 2}
    assert {cell.profile for cell in cells} == {"diffraction", "gaussian"}
    assert {cell.position_range_px for cell in cells} == {1, 4}
    assert min(cell.flux_e for cell in cells) == 10
    assert specification.realisations == 10_000


def test_cost_is_bounded() -> None:
    """In cells of 16 x 16 px, on which the time of a study depends."""
    assert sum(cell.pixels**2 / 256 for cell in paper_study().cells()) <= 350
    assert len(paper_study(quick=True).cells()) <= 40


@pytest.mark.parametrize("quick", [False, True])
def test_figure_five_needs_cells_of_its_own_for_faint_spots_at_much_noise_only(quick: bool) -> None:
    others = [name for name in FIGURES if name != "fig5"]
    with_it, without = paper_study(quick), paper_study(quick, others)
    extra = set(with_it.cells()) - set(without.cells())
    assert {(cell.flux_e, cell.read_noise_e) for cell in extra} == (set() if quick else {(50, 16)})


@pytest.mark.parametrize("quick", [False, True])
def test_one_figure_has_its_own_sweeps(quick: bool) -> None:
    for name in FIGURES:
        sweeps = paper_study(quick, [name]).sweeps
        assert sweeps
        assert all(sweep.name.startswith(name) for sweep in sweeps)


@pytest.mark.parametrize(
    ("figures", "message"),
    [(["fig9"], "figure = 'fig9'"), (["fig1"], "needs no study"), ([], "at least one")],
)
def test_bad_figures_are_refused(figures: list[str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        paper_study(figures=figures)
