"""The sweeps of constrained total-variation denoising: one iteration on every pixel of W sub-apertures.

The state holds, for every pixel, five vectors side by side (one memory stream): two versions of the dual
field p = (px, py), which take turns as the current and the previous one, and the normalised image g. What is
stored is 2 p, of length at most 2, since 2 / sqrt(a) is cheaper than 1 / sqrt(a).

v = div q - g / lambda of row y is all that row y - 1 still lacks for its update, so a rolling row of vectors
in scratch replaces every other intermediate image.

References: Chambolle 2004 (J. Math. Imaging Vis. 20, 89), Beck & Teboulle 2009 (IEEE Trans. Image Process.
18, 2419).
"""

from __future__ import annotations

from typing import Any

from faintspot.kernels.compiling import compiled, inlined
from faintspot.kernels.simd import (
    load,
    maximum,
    multiply_add,
    splat,
    square_root,
    store,
    twice_reciprocal_square_root,
    width_of,
)

STATE_VECTORS = 5  # vectors per pixel: 2 px, 2 py of both versions, g
IMAGE = 4  # place of g among them
FGP_STEP = 0.125
CHAMBOLLE_STEP = 0.25


@inlined
def _extrapolate(lanes: Any, state: Any, place: Any, current: Any, previous: Any, momentum: Any) -> Any:
    """Extrapolate: q = p + momentum * (p - p_previous) at one pixel."""
    width = width_of(lanes)
    px = load(lanes, state, place + current * width)
    py = load(lanes, state, place + (current + 1) * width)
    qx = multiply_add(momentum, px - load(lanes, state, place + previous * width), px)
    qy = multiply_add(momentum, py - load(lanes, state, place + (previous + 1) * width), py)
    return qx, qy


@inlined
def _project(px: Any, py: Any, four: Any) -> Any:
    """The nearest dual vector of length at most two."""
    shrink = twice_reciprocal_square_root(maximum(multiply_add(px, px, py * py), four))
    return px * shrink, py * shrink


@inlined
def _sweep(
    lanes: Any,
    state: Any,
    rows: Any,
    ny: Any,
    nx: Any,
    current: Any,
    previous: Any,
    momentum: Any,
    inverse: Any,
) -> Any:
    """One accelerated projected-gradient iteration on every pixel; return ||2 div q||^2 per lane.

    The new p replaces the previous one. `inverse` is 1 / lambda; `rows` has room for 3 (nx + 1) vectors: qx,
    qy, v of every pixel of the row above, side by side.
    """
    width = width_of(lanes)
    step, four, zero = splat(lanes, FGP_STEP), splat(lanes, 4.0), splat(lanes, 0.0)
    minus_inverse = splat(lanes, -2.0) * inverse
    pixel, line, slot = STATE_VECTORS * width, nx * STATE_VECTORS * width, 3 * width
    norm = zero
    q_left = zero
    for x in range(nx):
        place = x * pixel
        qx, qy = _extrapolate(lanes, state, place, current, previous, momentum)
        d = qx - q_left + qy
        norm = multiply_add(d, d, norm)
        v = multiply_add(load(lanes, state, place + IMAGE * width), minus_inverse, d)
        store(rows, x * slot, qx)
        store(rows, x * slot + width, qy)
        store(rows, x * slot + 2 * width, v)
        q_left = qx
    # A copy of the last v beyond the right edge: no gradient across it.
    store(rows, nx * slot + 2 * width, load(lanes, rows, nx * slot - width))
    for y in range(1, ny):
        v_above = load(lanes, rows, 2 * width)
        q_left = zero
        for x in range(nx):
            place = y * line + x * pixel
            above = place - line
            qx, qy = _extrapolate(lanes, state, place, current, previous, momentum)
            qy_above = load(lanes, rows, x * slot + width)
            d = (qx - q_left) + (qy - qy_above)
            norm = multiply_add(d, d, norm)
            v = multiply_add(load(lanes, state, place + IMAGE * width), minus_inverse, d)
            v_right = load(lanes, rows, x * slot + slot + 2 * width)
            px = multiply_add(step, v_right - v_above, load(lanes, rows, x * slot))
            py = multiply_add(step, v - v_above, qy_above)
            px, py = _project(px, py, four)
            store(state, above + previous * width, px)
            store(state, above + (previous + 1) * width, py)
            store(rows, x * slot, qx)
            store(rows, x * slot + width, qy)
            store(rows, x * slot + 2 * width, v)
            q_left, v_above = qx, v_right
        store(rows, nx * slot + 2 * width, load(lanes, rows, nx * slot - width))
    last = (ny - 1) * line
    v_above = load(lanes, rows, 2 * width)
    for x in range(nx):  # no gradient across the lower edge: py stays zero
        v_right = load(lanes, rows, x * slot + slot + 2 * width)
        px = multiply_add(step, v_right - v_above, load(lanes, rows, x * slot))
        px, py = _project(px, zero, four)
        store(state, last + x * pixel + previous * width, px)
        store(state, last + x * pixel + (previous + 1) * width, py)
        v_above = v_right
    return norm


@compiled
def sweep_fgp(
    lanes: Any, state: Any, rows: Any, ny: Any, nx: Any, current: Any, momentum: Any, inverse: Any
) -> Any:
    """One iteration of "fgp"; return ||div q||^2 per lane. See `_sweep`.

    `current` (0 or 2) says where the current p is: a constant in each branch, so that all of a pixel's
    vectors lie at fixed distances from one address.
    """
    if current == 0:
        norm = _sweep(lanes, state, rows, ny, nx, 0, 2, momentum, inverse)
    else:
        norm = _sweep(lanes, state, rows, ny, nx, 2, 0, momentum, inverse)
    return norm * splat(lanes, 0.25)


@compiled
def sweep_chambolle(lanes: Any, state: Any, rows: Any, ny: Any, nx: Any, current: Any, inverse: Any) -> Any:
    """One iteration of "chambolle" on every pixel; return ||div p||^2 per lane.

    `rows` has room for ny * nx vectors: v of the whole image. Meant to be compared with, not to be fast.
    """
    width = width_of(lanes)
    step, half_step = splat(lanes, CHAMBOLLE_STEP), splat(lanes, 0.5 * CHAMBOLLE_STEP)
    one, zero = splat(lanes, 1.0), splat(lanes, 0.0)
    minus_inverse = splat(lanes, -2.0) * inverse
    pixel, line = STATE_VECTORS * width, nx * STATE_VECTORS * width
    norm = zero
    for y in range(ny):
        for x in range(nx):
            place = y * line + x * pixel
            d = twice_divergence(lanes, state, place, current * width, y, x, line, pixel)
            norm = multiply_add(d, d, norm)
            v = multiply_add(load(lanes, state, place + IMAGE * width), minus_inverse, d)
            store(rows, (y * nx + x) * width, v)
    for y in range(ny):
        for x in range(nx):
            place = y * line + x * pixel
            here = (y * nx + x) * width
            v = load(lanes, rows, here)
            gx = load(lanes, rows, here + (width if x < nx - 1 else 0)) - v
            gy = load(lanes, rows, here + (nx * width if y < ny - 1 else 0)) - v
            shrink = one / multiply_add(half_step, square_root(multiply_add(gx, gx, gy * gy)), one)
            for axis, gradient in ((0, gx), (1, gy)):
                old = load(lanes, state, place + (current + axis) * width)
                new = multiply_add(step, gradient, old) * shrink
                store(state, place + (2 - current + axis) * width, new)
    return norm * splat(lanes, 0.25)


@compiled
def twice_divergence(
    lanes: Any, state: Any, place: Any, version: Any, y: Any, x: Any, line: Any, pixel: Any
) -> Any:
    """2 div p at one pixel, of the version of p that starts `version` elements after the pixel."""
    width = width_of(lanes)
    d = load(lanes, state, place + version) + load(lanes, state, place + version + width)
    if x > 0:
        d = d - load(lanes, state, place - pixel + version)
    if y > 0:
        d = d - load(lanes, state, place - line + version + width)
    return d
