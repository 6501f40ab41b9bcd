"""Position and flux of a spot by Fisher scoring: maximum likelihood, with a prior, or least squares.

The image g has mean m = F f(u - x), f the PSF, and variance VARIANCE + EXCESS m; pixels are weighted with
w = 1 / (WEIGHT_VARIANCE + WEIGHT_EXCESS m + MODEL_ERROR m^2). Parameters are x, y and the logarithm of F.
The score is sum w (g - m) dm, the information I = sum w dm dm', the covariance of the score
J = sum w^2 (VARIANCE + EXCESS m) dm dm', and that of the estimate I^-1 J I^-1, whatever the weights.
"""

import math

from faintspot.base.arrays import Array
from faintspot.slopes.kernels.compiling import compiled
from faintspot.slopes.kernels.groups import Group
from faintspot.slopes.kernels.positions import spot_rows as row
from faintspot.slopes.kernels.positions.spot_rows import (
    ModelTables,
    SpotScratch,
    eliminate_background,
    look_up,
    model_at,
    noise_of,
    weigh,
)
from faintspot.slopes.kernels.simd import (
    Lanes,
    absolute,
    load,
    maximum,
    minimum,
    multiply_add,
    select,
    splat,
    store,
    store_all,
    width_of,
)

LARGEST_FACTOR = 2.0  # on the flux, in one step
LEAST_FLUX_E = 1e-2


@compiled
def _separable_sums(group: Group, image: Array, own: SpotScratch) -> None:
    """Sum score, information and the score's covariance of every lane for a PSF of one separable term."""
    lanes, ny, nx, profiles, lane_values = group.lanes, group.ny, group.nx, own.profiles, own.lane_values
    width, place, padded = width_of(lanes), group.first * ny * nx, profiles.shape[3]
    zero = splat(lanes, 0.0)
    noise, flux = noise_of(lanes, lane_values), load(lanes, lane_values, row.FLUX * width)
    sx, sy, sf = zero, zero, zero
    ixx, iyy, iff, ixy, ixf, iyf = zero, zero, zero, zero, zero, zero
    jxx, jyy, jff, jxy, jxf, jyf = zero, zero, zero, zero, zero, zero
    for y in range(ny):
        fy = flux * load(lanes, profiles, (2 * padded + y) * width)
        dy = flux * load(lanes, profiles, (3 * padded + y) * width)
        s0, s1, i0, i1, i2, j0, j1, j2 = zero, zero, zero, zero, zero, zero, zero, zero
        for x in range(nx):
            fx, dx = load(lanes, profiles, x * width), load(lanes, profiles, (padded + x) * width)
            m = fx * fy
            at = (y * nx + x) * width
            w, wt = weigh(lanes, noise, group.variances, place + at, m)
            r = load(lanes, image, at) - m
            wf, wd = w * fx, w * dx
            s0, s1 = multiply_add(r, wf, s0), multiply_add(r, wd, s1)
            i0, i1, i2 = multiply_add(wf, fx, i0), multiply_add(wd, fx, i1), multiply_add(wd, dx, i2)
            tf, td = wt * wf, wt * wd
            j0, j1, j2 = multiply_add(tf, fx, j0), multiply_add(td, fx, j1), multiply_add(td, dx, j2)
        sx, sy, sf = multiply_add(s1, fy, sx), multiply_add(s0, dy, sy), multiply_add(s0, fy, sf)
        ff, fd, dd = fy * fy, fy * dy, dy * dy
        ixx, iyy, iff = multiply_add(i2, ff, ixx), multiply_add(i0, dd, iyy), multiply_add(i0, ff, iff)
        ixy, ixf, iyf = multiply_add(i1, fd, ixy), multiply_add(i1, ff, ixf), multiply_add(i0, fd, iyf)
        jxx, jyy, jff = multiply_add(j2, ff, jxx), multiply_add(j0, dd, jyy), multiply_add(j0, ff, jff)
        jxy, jxf, jyf = multiply_add(j1, fd, jxy), multiply_add(j1, ff, jxf), multiply_add(j0, fd, jyf)
    sums = sx, sy, sf, ixx, iyy, iff, ixy, ixf, iyf, jxx, jyy, jff, jxy, jxf, jyf
    store_all(lane_values, row.SCORE_X * width, sums)


@compiled
def _general_sums(group: Group, image: Array, own: SpotScratch) -> None:
    """Sum as `_separable_sums`, for a PSF of several separable terms."""
    lanes, ny, nx, profiles, lane_values = group.lanes, group.ny, group.nx, own.profiles, own.lane_values
    width, place = width_of(lanes), group.first * ny * nx
    zero = splat(lanes, 0.0)
    noise, flux = noise_of(lanes, lane_values), load(lanes, lane_values, row.FLUX * width)
    sx, sy, sf = zero, zero, zero
    ixx, iyy, iff, ixy, ixf, iyf = zero, zero, zero, zero, zero, zero
    jxx, jyy, jff, jxy, jxf, jyf = zero, zero, zero, zero, zero, zero
    for y in range(ny):
        for x in range(nx):
            m, mx, my = model_at(lanes, profiles, x, y)
            m, mx, my = flux * m, flux * mx, flux * my
            at = (y * nx + x) * width
            w, wt = weigh(lanes, noise, group.variances, place + at, m)
            wr = w * (load(lanes, image, at) - m)
            sx, sy, sf = multiply_add(wr, mx, sx), multiply_add(wr, my, sy), multiply_add(wr, m, sf)
            wx, wy, wm = w * mx, w * my, w * m
            ixx, iyy, iff = multiply_add(wx, mx, ixx), multiply_add(wy, my, iyy), multiply_add(wm, m, iff)
            ixy, ixf, iyf = multiply_add(wx, my, ixy), multiply_add(wx, m, ixf), multiply_add(wy, m, iyf)
            wx, wy, wm = wt * wx, wt * wy, wt * wm
            jxx, jyy, jff = multiply_add(wx, mx, jxx), multiply_add(wy, my, jyy), multiply_add(wm, m, jff)
            jxy, jxf, jyf = multiply_add(wx, my, jxy), multiply_add(wx, m, jxf), multiply_add(wy, m, jyf)
    sums = sx, sy, sf, ixx, iyy, iff, ixy, ixf, iyf, jxx, jyy, jff, jxy, jxf, jyf
    store_all(lane_values, row.SCORE_X * width, sums)


@compiled
def _move(lanes: Lanes, lane_values: Array) -> None:
    """Make one step, within bounds."""
    width = width_of(lanes)
    zero, one, tiny = splat(lanes, 0.0), splat(lanes, 1.0), splat(lanes, 1e-20)
    x, y, flux = (
        load(lanes, lane_values, row.X * width),
        load(lanes, lane_values, row.Y * width),
        load(lanes, lane_values, row.FLUX * width),
    )
    prior = load(lanes, lane_values, row.PRIOR_WEIGHT * width)
    sf, ixf, iyf = (
        load(lanes, lane_values, row.SCORE_F * width),
        load(lanes, lane_values, row.I_XF * width),
        load(lanes, lane_values, row.I_YF * width),
    )
    # The flux is eliminated first, then y; a lane without information does not move.
    inverse_ff = one / maximum(load(lanes, lane_values, row.I_FF * width), tiny)
    cx, cy = ixf * inverse_ff, iyf * inverse_ff
    bx = load(lanes, lane_values, row.SCORE_X * width) - cx * sf
    by = load(lanes, lane_values, row.SCORE_Y * width) - cy * sf
    bx = multiply_add(prior, load(lanes, lane_values, row.PRIOR_X * width) - x, bx)
    by = multiply_add(prior, load(lanes, lane_values, row.PRIOR_Y * width) - y, by)
    axx = load(lanes, lane_values, row.I_XX * width) - cx * ixf + prior
    ayy = load(lanes, lane_values, row.I_YY * width) - cy * iyf + prior
    axy = load(lanes, lane_values, row.I_XY * width) - cx * iyf
    slope = axy / maximum(ayy, tiny)
    left = axx - slope * axy
    # An almost singular matrix (round-off) gives no direction to go in.
    sound = minimum(left - splat(lanes, 1e-5) * axx, ayy) > zero
    dx = select(sound, (bx - slope * by) / maximum(left, tiny), zero)
    dy = select(sound, (by - axy * dx) / maximum(ayy, tiny), zero)
    # A step is too long by how much more flux there is than the model has: linear is only their product.
    growth = maximum((sf - ixf * dx - iyf * dy) * inverse_ff, one)
    most = load(lanes, lane_values, row.LARGEST_MOVE * width)
    least = zero - most
    dx, dy = minimum(maximum(dx / growth, least), most), minimum(maximum(dy / growth, least), most)
    store(lane_values, row.MOVE_BEFORE * width, load(lanes, lane_values, row.MOVE * width))
    store(lane_values, row.MOVE * width, maximum(absolute(dx), absolute(dy)))
    # Where a bound stops one axis, the other one goes to the best position on the bound.
    low_x, high_x = load(lanes, lane_values, row.LOW_X * width), load(lanes, lane_values, row.HIGH_X * width)
    low_y, high_y = load(lanes, lane_values, row.LOW_Y * width), load(lanes, lane_values, row.HIGH_Y * width)
    left_x, right_x, left_y, right_y = low_x - x, high_x - x, low_y - y, high_y - y
    free_x = minimum(dx - left_x, right_x - dx) >= zero
    dx = select(free_x, dx, minimum(maximum(dx, left_x), right_x))
    along = (by - axy * dx) / maximum(ayy, tiny) / growth
    dy = select(free_x, dy, minimum(maximum(along, least), most))
    free_y = minimum(dy - left_y, right_y - dy) >= zero
    dy = select(free_y, dy, minimum(maximum(dy, left_y), right_y))
    along = (bx - axy * dy) / maximum(axx, tiny) / growth
    along = minimum(maximum(minimum(maximum(along, least), most), left_x), right_x)
    dx = select(free_y, dx, along)
    df = (sf - ixf * dx - iyf * dy) * inverse_ff
    factor = minimum(maximum(one + df, splat(lanes, 1.0 / LARGEST_FACTOR)), splat(lanes, LARGEST_FACTOR))
    x, y = minimum(maximum(x + dx, low_x), high_x), minimum(maximum(y + dy, low_y), high_y)
    store(lane_values, row.X * width, x)
    store(lane_values, row.Y * width, y)
    store(lane_values, row.FLUX * width, maximum(flux * factor, splat(lanes, LEAST_FLUX_E)))


@compiled
def _store_errors(width: int, lane: int, flux: float, lane_values: Array) -> None:
    """Write what a lane's sums, made with light `flux`, say: the flux seen, standard errors and covariance.

    The covariance of x and y is A^-1 (J + prior) A^-1, A = I + prior.
    """
    prior = float(lane_values[row.PRIOR_WEIGHT * width + lane])
    iff = float(lane_values[row.I_FF * width + lane])
    lane_values[row.ERROR_X * width + lane] = math.inf
    lane_values[row.ERROR_Y * width + lane] = math.inf
    lane_values[row.COVARIANCE * width + lane] = 0.0
    lane_values[row.SEEN * width + lane] = 0.0
    lane_values[row.SEEN_ERROR * width + lane] = math.inf
    if not iff > 0.0:
        return
    # The model is proportional to the flux: sum w g m / sum w m^2 is the flux that fits best.
    lane_values[row.SEEN * width + lane] = flux * (1.0 + lane_values[row.SCORE_F * width + lane] / iff)
    lane_values[row.SEEN_ERROR * width + lane] = flux / math.sqrt(iff)
    cx, cy = lane_values[row.I_XF * width + lane] / iff, lane_values[row.I_YF * width + lane] / iff
    axx = lane_values[row.I_XX * width + lane] - cx * lane_values[row.I_XF * width + lane] + prior
    ayy = lane_values[row.I_YY * width + lane] - cy * lane_values[row.I_YF * width + lane] + prior
    axy = lane_values[row.I_XY * width + lane] - cx * lane_values[row.I_YF * width + lane]
    determinant = axx * ayy - axy * axy
    if not determinant > 1e-5 * axx * ayy:
        return
    # With the flux eliminated, the score is s - c s_F; so its covariance is
    jxf, jyf, jff = (
        lane_values[row.J_XF * width + lane],
        lane_values[row.J_YF * width + lane],
        lane_values[row.J_FF * width + lane],
    )
    bxx = lane_values[row.J_XX * width + lane] - 2.0 * cx * jxf + cx * cx * jff + prior
    byy = lane_values[row.J_YY * width + lane] - 2.0 * cy * jyf + cy * cy * jff + prior
    bxy = lane_values[row.J_XY * width + lane] - cy * jxf - cx * jyf + cx * cy * jff
    vx = (ayy * ayy * bxx - 2.0 * ayy * axy * bxy + axy * axy * byy) / (determinant * determinant)
    vy = (axx * axx * byy - 2.0 * axx * axy * bxy + axy * axy * bxx) / (determinant * determinant)
    if vx > 0.0 and vy > 0.0:
        lane_values[row.ERROR_X * width + lane] = math.sqrt(vx)
        lane_values[row.ERROR_Y * width + lane] = math.sqrt(vy)
        vxy = (axx * ayy + axy * axy) * bxy - axy * (ayy * bxx + axx * byy)
        lane_values[row.COVARIANCE * width + lane] = vxy / (determinant * determinant)


@compiled
def fit_group(group: Group, tables: ModelTables, image: Array, own: SpotScratch) -> None:
    """Fit position and flux of the W spots of a group.

    Parameters
    ----------
    group : Group
        Its variances stand in place of VARIANCE, also in the weights.
    tables : ModelTables
        Always as many steps, so that the time is known and lanes do not depend on each other.
    image : (ny * nx * W,)
    own : SpotScratch
        In its rows, the start (X, Y, FLUX) and everything marked "in" is read; position, flux, errors and
        what is SEEN are written.
    """
    for step in range(tables.steps):
        look_up(group, tables.model, own)
        if own.profiles.shape[1] == 1:
            _separable_sums(group, image, own)
        else:
            _general_sums(group, image, own)
        if tables.background:
            eliminate_background(group, image, own)
        if step == tables.steps - 1:
            width = width_of(group.lanes)
            for lane in range(width):
                _store_errors(width, lane, float(own.lane_values[row.FLUX * width + lane]), own.lane_values)
        _move(group.lanes, own.lane_values)
