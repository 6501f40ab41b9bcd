"""Constant background fitted along with the spot, for an unknown dark level or a changing sky.

The image's mean is F f + b. b enters linearly and carries no noise of its own (that of a known background is
in VARIANCE), so it needs no steps: with B the sums of a model's derivatives with the constant, eliminating b
from the normal equations gives the same fit of x, y and F alone, with I - I_B I_B' / I_BB for I (its Schur
complement), and so on. PSF photometry and localisation microscopy fit the same four parameters (Stetson 1987,
PASP 99, 191; Smith et al. 2010, Nature Methods 7, 373).
"""

from __future__ import annotations

from typing import Any

from faintspot.slopes.kernels.compilation.compiling import compiled
from faintspot.slopes.kernels.compilation.simd import (
    load,
    maximum,
    multiply_add,
    select,
    splat,
    store,
    width_of,
)
from faintspot.slopes.kernels.spot_fits.spot_rows import (
    FLUX,
    I_FF,
    I_XF,
    I_XX,
    I_XY,
    I_YF,
    I_YY,
    J_FF,
    J_XF,
    J_XX,
    J_XY,
    J_YF,
    J_YY,
    SCORE_F,
    SCORE_X,
    SCORE_Y,
    model_at,
    noise_of,
    weigh,
)

_LEAST_LEFT = 1e-5  # of the information on the flux: below it is round-off, and the spot resembles a constant


@compiled
def subtract_background(lanes: Any, image: Any, pixels: Any, flux: Any) -> None:
    """Subtract from every lane's image the constant that leaves it `flux` (a vector, electrons)."""
    width = width_of(lanes)
    even, odd = splat(lanes, 0.0), splat(lanes, 0.0)  # neither addition waits for the other
    for i in range(0, pixels - 1, 2):
        even = even + load(lanes, image, i * width)
        odd = odd + load(lanes, image, (i + 1) * width)
    if pixels % 2 == 1:
        even = even + load(lanes, image, (pixels - 1) * width)
    level = (even + odd - flux) * splat(lanes, 1.0 / pixels)
    for i in range(pixels):
        store(image, i * width, load(lanes, image, i * width) - level)


@compiled
def eliminate_background(
    lanes: Any, image: Any, variances: Any, place: Any, ny: Any, nx: Any, profiles: Any, lane_values: Any
) -> None:
    """Turn the sums of a fit of x, y and the flux into those of a fit that has a constant as well.

    Parameters as `likelihood.fit_group`; SCORE_*, I_* and J_* are read and written.
    """
    width = width_of(lanes)
    zero = splat(lanes, 0.0)
    noise, flux = noise_of(lanes, lane_values), load(lanes, lane_values, FLUX * width)
    s, i, ix, iy, im, j, jx, jy, jm = zero, zero, zero, zero, zero, zero, zero, zero, zero
    for y in range(ny):
        for x in range(nx):
            m, mx, my = model_at(lanes, profiles, x, y)
            m = flux * m
            at = (y * nx + x) * width
            w, wt = weigh(lanes, noise, variances, place + at, m)
            s = multiply_add(w, load(lanes, image, at) - m, s)
            i, im = i + w, multiply_add(w, m, im)
            ix, iy = multiply_add(w, mx, ix), multiply_add(w, my, iy)
            wt = w * wt
            j, jm = j + wt, multiply_add(wt, m, jm)
            jx, jy = multiply_add(wt, mx, jx), multiply_add(wt, my, jy)
    inverse = splat(lanes, 1.0) / maximum(i, splat(lanes, 1e-30))
    cx, cy, cf = flux * ix * inverse, flux * iy * inverse, im * inverse
    _add(lanes, lane_values, SCORE_X, zero - cx * s)
    _add(lanes, lane_values, SCORE_Y, zero - cy * s)
    _add(lanes, lane_values, SCORE_F, zero - cf * s)
    whole = load(lanes, lane_values, I_FF * width)
    _add(lanes, lane_values, I_XX, zero - cx * cx * i)
    _add(lanes, lane_values, I_YY, zero - cy * cy * i)
    _add(lanes, lane_values, I_FF, zero - cf * cf * i)
    _add(lanes, lane_values, I_XY, zero - cx * cy * i)
    _add(lanes, lane_values, I_XF, zero - cx * cf * i)
    _add(lanes, lane_values, I_YF, zero - cy * cf * i)
    left = load(lanes, lane_values, I_FF * width)
    store(lane_values, I_FF * width, select(left > splat(lanes, _LEAST_LEFT) * whole, left, zero))
    jx, jy = flux * jx, flux * jy
    _add(lanes, lane_values, J_XX, cx * (cx * j - jx - jx))
    _add(lanes, lane_values, J_YY, cy * (cy * j - jy - jy))
    _add(lanes, lane_values, J_FF, cf * (cf * j - jm - jm))
    _add(lanes, lane_values, J_XY, cx * cy * j - cx * jy - cy * jx)
    _add(lanes, lane_values, J_XF, cx * cf * j - cx * jm - cf * jx)
    _add(lanes, lane_values, J_YF, cy * cf * j - cy * jm - cf * jy)


@compiled
def _add(lanes: Any, lane_values: Any, row: Any, change: Any) -> None:
    """Add to a row."""
    at = row * width_of(lanes)
    store(lane_values, at, load(lanes, lane_values, at) + change)
