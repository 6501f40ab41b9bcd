"""The paper's study: its cells and its report."""

from tests.refusals import refused

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


def test_one_figure_has_its_own_sweeps() -> None:
    """Figure 5 needs cells of its own for faint spots at much noise only."""
    others = [name for name in FIGURES if name != "fig5"]
    for quick, own in ((False, {(50, 16)}), (True, set())):
        extra = set(paper_study(quick).cells()) - set(paper_study(quick, others).cells())
        assert {(cell.flux_e, cell.read_noise_e) for cell in extra} == own
        for name in FIGURES:
            sweeps = paper_study(quick, [name]).sweeps
            assert sweeps
            assert all(sweep.name.startswith(name) for sweep in sweeps)
    for figures, word in ((["fig9"], "figure = 'fig9'"), (["fig1"], "fig1"), ([], "figure")):
        with refused(word):
            paper_study(figures=figures)
