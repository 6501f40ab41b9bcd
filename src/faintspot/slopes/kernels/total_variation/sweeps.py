"""The sweeps of constrained total-variation denoising: one iteration on every pixel of W sub-apertures.

The state holds, for every pixel, five vectors side by side (one memory stream): two versions of the dual
field p = (px, py), which take turns as the current and the previous one, and the normalised image g. What is
stored is 2 p, of length at most 2, since 2 / sqrt(a) is cheaper than 1 / sqrt(a).

v = div q - g / lambda of row y is all that row y - 1 still lacks for its update, so a rolling row of vectors
in scratch replaces every other intermediate image. Rows are swept in pairs, so that only every second row
passes through it: see `_turn`.

References: Chambolle 2004 (J. Math. Imaging Vis. 20, 89), Beck & Teboulle 2009 (IEEE Trans. Image Process.
18, 2419).
"""

from typing import Any

from faintspot.base.arrays import Array
from faintspot.slopes.kernels.compiling import compiled, inlined, vector_registers
from faintspot.slopes.kernels.simd import (
    Lanes,
    Pair,
    Vector,
    align_stack,
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
# With 16 registers, values extrapolated ahead would be spilled to memory and read back.
EXTRAPOLATES_AHEAD = vector_registers() >= 32


Factors = tuple[Vector, Vector, Vector]
"""Momentum, -2 FGP_STEP / lambda, and FGP_STEP."""
Carried = tuple[Any, ...]
"""Norm, v above, what is extrapolated ahead, values at the left and place behind, for the next column."""


@inlined
def _extrapolate(
    lanes: Lanes, state: Array, place: int, current: int, previous: int, momentum: Vector
) -> Pair:
    """Extrapolate: q = p + momentum * (p - p_previous) at one pixel."""
    width = width_of(lanes)
    px = load(lanes, state, place + current)
    py = load(lanes, state, place + current + width)
    qx = multiply_add(momentum, px - load(lanes, state, place + previous), px)
    qy = multiply_add(momentum, py - load(lanes, state, place + previous + width), py)
    return qx, qy


@inlined
def _extrapolate_pair(
    lanes: Lanes, state: Array, place: int, line: int, versions: tuple[int, int], momentum: Vector
) -> tuple[Vector, Vector, Vector, Vector]:
    """Extrapolate one pixel of the upper row and the pixel below it."""
    qx, qy = _extrapolate(lanes, state, place, versions[0], versions[1], momentum)
    rx, ry = _extrapolate(lanes, state, place + line, versions[0], versions[1], momentum)
    return qx, qy, rx, ry


@inlined
def store_projected(lanes: Lanes, state: Array, target: int, px: Vector, py: Vector) -> None:
    """Store the nearest dual vector of length at most two."""
    bounded_square = maximum(multiply_add(px, px, py * py), splat(lanes, 4.0))
    shrink = twice_reciprocal_square_root(bounded_square)
    store(state, target, px * shrink)
    store(state, target + width_of(lanes), py * shrink)


@inlined
def _turn(
    lanes: Lanes,
    state: Array,
    rows: Array,
    x: int,
    places: tuple[int, int],
    line: int,
    versions: tuple[int, int],
    factors: Factors,
    top: bool,
    left_edge: bool,
    carried: Carried,
) -> Carried:
    """Process one column of a pair of rows; return the values that the next turn needs.

    Extrapolate this column, or the next one where there are registers to keep it in; complete v of this
    column; from that, update p in the row above the pair (this column) and in its upper row (the column
    before, `behind`). Sums begin with terms known early, and the extrapolation ahead comes before p is
    stored: the chain of operations on a pixel takes longer than its arithmetic, and the processor overlaps
    only the turns that its window of instructions holds.
    """
    width = width_of(lanes)
    previous = versions[1]
    momentum, minus_inverse, step = factors
    place, following = places
    norm, v_above, ahead, (ax, ay, av, bx, bv), behind = carried
    if EXTRAPOLATES_AHEAD:
        qx, qy, rx, ry = ahead
    else:
        qx, qy, rx, ry = _extrapolate_pair(lanes, state, place, line, versions, momentum)
    here = x * 3 * width
    dx, ex = (qx, rx) if left_edge else (qx - ax, rx - bx)
    if top:
        d = dx + qy
    else:
        qy_above = load(lanes, rows, here + width)
        d = dx + (qy - qy_above)
    e = ex + (ry - qy)
    v = multiply_add(d, step, load(lanes, state, place + IMAGE * width) * minus_inverse)
    w = multiply_add(e, step, load(lanes, state, place + line + IMAGE * width) * minus_inverse)
    norm = multiply_add(e, e, multiply_add(d, d, norm))
    if not top:
        v_right = load(lanes, rows, here + 5 * width)
        fx = (v_right - v_above) + load(lanes, rows, here)
        fy = v + (qy_above - v_above)
        v_above = v_right
    store(rows, here, rx)
    store(rows, here + width, ry)
    store(rows, here + 2 * width, w)
    if EXTRAPOLATES_AHEAD:
        ahead = _extrapolate_pair(lanes, state, following, line, versions, momentum)
    if not top:
        store_projected(lanes, state, place - line + previous, fx, fy)
    # At the left edge: the rightmost pixel of the pair above, which has no gradient along x.
    hx = ax if left_edge else v + (ax - av)
    hy = (bv - av) + ay
    store_projected(lanes, state, behind + previous, hx, hy)
    return norm, v_above, ahead, (qx, qy, v, rx, w), place


@inlined
def _no_work(lanes: Lanes, norm: Vector, place: int) -> Carried:
    """Return the initial `carried`: its first update, of zero at `place`, is overwritten later."""
    zero = splat(lanes, 0.0)
    return norm, zero, (zero, zero, zero, zero), (zero, zero, zero, zero, zero), place


@inlined
def _sweep_pair(
    lanes: Lanes,
    state: Array,
    rows: Array,
    y: int,
    nx: int,
    versions: tuple[int, int],
    factors: Factors,
    top: bool,
    carried: Carried,
) -> Carried:
    """All turns of rows y and y + 1, `top` when y = 0; `rows`: those of row y - 1, then of row y + 1."""
    width = width_of(lanes)
    pixel, line = STATE_VECTORS * width, nx * STATE_VECTORS * width
    place, last = y * line, y * line + line - pixel
    norm, v_above, ahead, left, behind = carried
    if EXTRAPOLATES_AHEAD:
        ahead = _extrapolate_pair(lanes, state, place, line, versions, factors[0])
    if not top:
        v_above = load(lanes, rows, 2 * width)
    carried = norm, v_above, ahead, left, behind
    places = place, min(place + pixel, last)
    carried = _turn(lanes, state, rows, 0, places, line, versions, factors, top, True, carried)
    for x in range(1, nx):
        place += pixel
        places = place, min(place + pixel, last)
        carried = _turn(lanes, state, rows, x, places, line, versions, factors, top, False, carried)
    # A copy of the last v beyond the right edge: no gradient across it.
    store(rows, (3 * nx + 2) * width, carried[3][4])
    return carried


@inlined
def _finish(lanes: Lanes, state: Array, previous: int, carried: Carried) -> Vector:
    """Update p in the rightmost pixel of the last pair's upper row; return the norm."""
    norm, _, _, (ax, ay, av, _, bv), behind = carried
    store_projected(lanes, state, behind + previous, ax, (bv - av) + ay)
    return norm


@inlined
def _first_row(
    lanes: Lanes, state: Array, rows: Array, nx: int, versions: tuple[int, int], factors: Factors
) -> Vector:
    """Put the first row into `rows`; return the norm."""
    width = width_of(lanes)
    momentum, minus_inverse, step = factors
    norm, q_left, v = splat(lanes, 0.0), splat(lanes, 0.0), splat(lanes, 0.0)
    for x in range(nx):
        place, here = x * STATE_VECTORS * width, x * 3 * width
        qx, qy = _extrapolate(lanes, state, place, versions[0], versions[1], momentum)
        d = (qx - q_left) + qy
        norm = multiply_add(d, d, norm)
        v = multiply_add(load(lanes, state, place + IMAGE * width), minus_inverse, d * step)
        store(rows, here, qx)
        store(rows, here + width, qy)
        store(rows, here + 2 * width, v)
        q_left = qx
    store(rows, 3 * nx * width + 2 * width, v)
    return norm


@inlined
def _update_last_row(lanes: Lanes, state: Array, rows: Array, target: int, nx: int) -> None:
    """Update p of the row in `rows`, the image's last: no gradient across the lower edge, py stays zero."""
    width = width_of(lanes)
    zero, v = splat(lanes, 0.0), load(lanes, rows, 2 * width)
    for x in range(nx):
        here = x * 3 * width
        v_right = load(lanes, rows, here + 5 * width)
        px = (v_right - v) + load(lanes, rows, here)
        store_projected(lanes, state, target + x * STATE_VECTORS * width, px, zero)
        v = v_right


@compiled
def sweep_fgp(
    lanes: Lanes, state: Array, rows: Array, ny: int, nx: int, current: int, momentum: Vector, inverse: Vector
) -> Vector:
    """Make one accelerated projected-gradient iteration on each pixel; return ||div q||^2 per lane.

    `current` (0 or 2) is the position of the current p; the new p replaces the other version. `inverse`
    is 1 / lambda. `rows` has space for 3 (nx + 1) vectors: qx, qy and step * v of each pixel of one
    row.
    """
    align_stack(lanes)
    width = width_of(lanes)
    line = nx * STATE_VECTORS * width
    versions = current * width, (2 - current) * width
    factors = momentum, splat(lanes, -2.0 * FGP_STEP) * inverse, splat(lanes, FGP_STEP)
    if ny % 2 == 0:
        carried = _no_work(lanes, splat(lanes, 0.0), 0)
        carried = _sweep_pair(lanes, state, rows, 0, nx, versions, factors, True, carried)
        norm = _finish(lanes, state, versions[1], carried)
        y = 2
    else:
        norm = _first_row(lanes, state, rows, nx, versions, factors)
        y = 1
    if y < ny:
        carried = _no_work(lanes, norm, y * line)
        while y < ny:
            carried = _sweep_pair(lanes, state, rows, y, nx, versions, factors, False, carried)
            y += 2
        norm = _finish(lanes, state, versions[1], carried)
    _update_last_row(lanes, state, rows, (ny - 1) * line + versions[1], nx)
    return norm * splat(lanes, 0.25)


@compiled
def sweep_chambolle(
    lanes: Lanes, state: Array, rows: Array, ny: int, nx: int, current: int, inverse: Vector
) -> Vector:
    """Make one "chambolle" iteration on each pixel; return ||div p||^2 per lane, of the new p.

    With the norm of the previous p, one iteration late, the multiplier would oscillate near
    infeasibility.

    `rows` has space for ny * nx vectors: v of the whole image. It is a reference for comparison, not
    optimised.
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
            d = twice_divergence(lanes, state, place, (2 - current) * width, y, x, line, pixel)
            norm = multiply_add(d, d, norm)
    return norm * splat(lanes, 0.25)


@compiled
def twice_divergence(
    lanes: Lanes, state: Array, place: int, version: int, y: int, x: int, line: int, pixel: int
) -> Vector:
    """2 div p at one pixel, of the version of p that starts `version` elements after the pixel."""
    width = width_of(lanes)
    d = load(lanes, state, place + version) + load(lanes, state, place + version + width)
    if x > 0:
        d = d - load(lanes, state, place - pixel + version)
    if y > 0:
        d = d - load(lanes, state, place - line + version + width)
    return d
