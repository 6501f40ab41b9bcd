"""Picture of a point-spread function."""

from __future__ import annotations

from typing import TYPE_CHECKING

from faintspot.base.checks import number_between
from faintspot.base.report.plots import Picture, draw
from faintspot.slopes.spots.psf import PSF

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SHOWN_WIDTHS = 4.0  # FWHM to each side


def plot_psf(psf: PSF, axes: Axes | None, which: int) -> Axes:
    """Draw what `PSF.plot` returns."""
    image = psf.samples[int(number_between("which", which, 0, len(psf.samples) - 1, integer=True))]
    y, x = (side / (2 * psf.oversampling) for side in image.shape)
    title = f"PSF, FWHM {' x '.join(f'{width:.3g}' for width in psf.fwhm_px[which])} px"
    shown = min(_SHOWN_WIDTHS * float(psf.fwhm_px[which].max()), x, y)
    label, style = "fraction of the flux in a pixel", {"extent": (-x, x, -y, y)}
    ends = -shown, shown
    picture = Picture(image, label, title, "x (px)", "y (px)", style, x_range=ends, y_range=ends)
    return draw([[picture]], axes)  # type: ignore[no-any-return]
