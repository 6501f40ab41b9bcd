"""The claims of Basden et al. 2015 (arXiv:1503.06043), each with its rule, and the verdicts on them."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from faintspot.study import judges
from faintspot.study.arm_names import NO_TV, TV
from faintspot.study.verdicts import Case, Finding, Verdict

if TYPE_CHECKING:
    import xarray

BEST_MODE = "best"
FIXED_MODE = "fixed40"


def fixed_mode(dataset: xarray.Dataset) -> str:
    """Return the mode of one k for all arms that is shown: k = 40, or else the largest of the study."""
    fixed = [str(name) for name in dataset["mode"].values if str(name).startswith("fixed")]
    return FIXED_MODE if FIXED_MODE in fixed or not fixed else fixed[-1]


def verdicts(dataset: xarray.Dataset, seed: int = 2015) -> list[Verdict]:
    """Return the verdict on every claim of the paper.

    Parameters
    ----------
    dataset : xarray.Dataset
        A study; cells that are not finished do not count.
    seed : int
        Of the bootstraps, so that the same study always gets the same verdicts.
    """
    modes = [str(name) for name in dataset["mode"].values]
    if not {NO_TV, TV} <= {str(name) for name in dataset["arm"].values}:
        return []
    results = []
    for number, (claim, rule, judge) in enumerate(_CLAIMS, start=1):
        findings = []
        for mode in (BEST_MODE, fixed_mode(dataset)):
            rng = np.random.default_rng([seed, number])
            findings.append(Finding(mode, judge(dataset, mode, rng) if mode in modes else []))
        results.append(Verdict(number, claim, rule, *findings))
    return results


_Judge = Callable[["xarray.Dataset", str, np.random.Generator], list[Case]]
_INTERVAL = "all intervals 95 %"
_CLAIMS: tuple[tuple[str, str, _Judge], ...] = (
    (
        "30 photons with TV equal 80 without (0.1 e- read noise)",
        f"Holds where the interval of the flux gain at 80 e- ({_INTERVAL}) reaches 80 / 30 = 2.67; in part "
        "where it reaches half of that in magnitudes, a factor 1.63.",
        judges.thirty_equal_eighty,
    ),
    (
        "A factor 2 to 3 less light, up to one magnitude",
        "Of each configuration (Nyquist-sampled, 16 × 16 px) the flux with the largest gain by the "
        "interval's lower end. Holds where the interval reaches 2; in part where it reaches half of "
        "that in magnitudes, a factor 1.41.",
        judges.two_to_three,
    ),
    (
        "Small spots gain most",
        f"Flux gains at R = {judges.LEVEL_PX} px. Holds where the smallest spot's gain is above every other "
        "size's by 1.96 standard errors; in part where not decided; not where another size gains more.",
        judges.small_spots,
    ),
    (
        "R with TV does not depend on the sub-aperture's size",
        f"R of the largest window over R of the smallest. Holds where the interval reaches within "
        f"{judges.EQUAL:.0%} of 1; in part where R changes, but by less than without TV.",
        judges.independent_of_pixels,
    ),
    (
        "R depends less on the number of brightest pixels kept",
        "Best k: largest over smallest R as k runs, at the strength chosen for best k. Fixed k: the same "
        "over the fixed k of the study, the strength chosen for each. Holds where TV's is smaller by 1.96 "
        "standard errors; in part where not decided.",
        judges.less_dependence_on_k,
    ),
    (
        "Elongated spots: the gain grows with read noise, up to 25 % less light above 3 e-",
        f"Flux gains at R = {judges.LEVEL_PX} px. Holds where ln(gain) grows with log(read noise) by 1.96 "
        "standard errors and the interval of the largest saving at 3 e- or more reaches 25 %; in part for "
        "one of the two.",
        judges.elongated,
    ),
    (
        "One magnitude at 16 e- read noise",
        "The largest gain, by the interval's lower end, at R = 0.1, 0.15, 0.2 or 0.3 px. Holds where its "
        "interval reaches 1 mag; in part where it reaches 0.5 mag.",
        judges.one_magnitude,
    ),
    (
        "Never worse on average",
        "Paired differences of R in all cells, with a false-alarm rate of 5 % for all of them together "
        "(Bonferroni). Holds where no cell is worse; in part where more cells are better than worse.",
        judges.never_worse,
    ),
)
