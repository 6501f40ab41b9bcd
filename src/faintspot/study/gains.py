"""The flux gain of TV in every mode: with the best k of each arm, and with each fixed k in both."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from faintspot.study.curves import Configuration, Gain, gain_at_error, study_curves
from faintspot.study.judges import LEVEL_PX

if TYPE_CHECKING:
    import xarray


def gains_by_mode(
    dataset: xarray.Dataset, level_px: float = LEVEL_PX
) -> dict[Configuration, dict[str, Gain | None]]:
    """Return the flux gain of TV over no denoising at one R, by configuration and mode.

    Parameters
    ----------
    dataset : xarray.Dataset
        Results of a study.
    level_px : float
        R at which the flux that both arms need is compared, px.

    Returns
    -------
    dict
        Configurations that have a gain in at least one mode; None where a mode has none, as when the error
        without denoising does not come down to that level.
    """
    rng = np.random.default_rng(0)  # of the bootstrap: the same study gives the same page
    table: dict[Configuration, dict[str, Gain | None]] = {}
    for mode in dataset["mode"].values:
        for configuration, curve in study_curves(dataset, str(mode)).items():
            gain = gain_at_error(curve, level_px, rng) if curve.has("tv", "plain") else None
            table.setdefault(configuration, {})[str(mode)] = gain
    return {key: gains for key, gains in table.items() if any(gain is not None for gain in gains.values())}
