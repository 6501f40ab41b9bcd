"""Constrained total-variation denoising of one sub-aperture by a warp, everything in registers.

The algorithm is that of `kernels.total_variation.denoise`, which says how and why; two things differ.
Beside the image g (normalised), a thread keeps p and the extrapolated q = p + momentum (p - previous p) of
each of its pixels, both of which an iteration replaces in place. And a warp stops when its own image has
converged. "chambolle" has no momentum: its current field is q, the previous one p.

At an edge of the window a step of zero takes the place of a gradient that is not there: the dual field then
stays zero on it, also in threads and rows that have no pixel. So wherever a neighbour beyond the edge is
asked for, the thread that answers holds zero.

References: Chambolle 2004 (J. Math. Imaging Vis. 20, 89), Beck & Teboulle 2009 (IEEE Trans. Image Process.
18, 2419).
"""

from __future__ import annotations

import math
from typing import Any

from numba import cuda, float32, int32

from faintspot.slopes.kernels.cuda import warp
from faintspot.slopes.kernels.cuda.compiling import device
from faintspot.slopes.kernels.cuda.flat_start import make_start_flat
from faintspot.slopes.kernels.cuda.strips import WARP, Strips
from faintspot.slopes.kernels.total_variation.denoise import (
    CHAMBOLLE,
    CHECK_INTERVAL,
    FGP,
    HIGHEST_STRENGTH,
    LOWERED_STRENGTH,
)
from faintspot.slopes.kernels.total_variation.flat_start import MOMENTUM_AGE
from faintspot.slopes.kernels.total_variation.sweeps import CHAMBOLLE_STEP, FGP_STEP

shuffle, warp_total, inverse_root = warp.shuffle, warp.total, warp.inverse_root
largest, smallest = warp.largest, warp.smallest

SMALLEST_STRENGTH = 1e-8  # relative to the image's range: below its rounding error
SMALLEST_RANGE = 1e-30  # of an image: smaller ones count as constant


@device
def next_momentum(age: Any) -> Any:
    """Return the next member of the sequence that the momentum follows, and the momentum."""
    square = float32(1.0) + float32(4.0) * age * age
    new_age = float32(0.5) * (float32(1.0) + square * inverse_root(square))
    return new_age, (age - float32(1.0)) * inverse_root(new_age * new_age)


@device
def advance_fgp(q: Any, p: Any, r: Any, step_x: Any, step_y: Any, momentum: Any) -> None:
    """Replace p by the projection of q + step, and extrapolate; q and p are (2, rows)."""
    x, y = q[0, r] + step_x, q[1, r] + step_y
    shrink = inverse_root(max(x * x + y * y, float32(1.0)))
    x *= shrink
    y *= shrink
    q[0, r] = x + momentum * (x - p[0, r])
    q[1, r] = y + momentum * (y - p[1, r])
    p[0, r], p[1, r] = x, y


@device
def advance_chambolle(q: Any, p: Any, r: Any, step_x: Any, step_y: Any, momentum: Any) -> None:
    """Replace q by Chambolle's step from it; p becomes the previous q."""
    shrink = float32(1.0) / (float32(1.0) + math.sqrt(step_x * step_x + step_y * step_y))
    p[0, r], p[1, r] = q[0, r], q[1, r]
    q[0, r] = (q[0, r] + step_x) * shrink
    q[1, r] = (q[1, r] + step_y) * shrink


def make_sweep(strips: Strips, algorithm: bool | None) -> Any:
    """Return the function that makes one iteration on all pixels, and sums ||div q||^2 of this thread's."""
    rows, last, nx = strips.rows, strips.last_row, strips.nx
    advance = advance_fgp if algorithm is FGP else advance_chambolle
    step = float(FGP_STEP if algorithm is FGP else CHAMBOLLE_STEP)
    mask = WARP - 1

    @device
    def sweep(
        q: Any, p: Any, g: Any, lane: Any, in_row: Any, in_last: Any, inverse: Any, momentum: Any
    ) -> Any:
        """`in_row`: 1 where there is a pixel to the right; `in_last`: 0 in the last strip, else 1."""
        left, right = (lane - 1) & mask, (lane + 1) & mask
        above, below = (lane - nx) & mask, (lane + nx) & mask
        d = (q[0, 0] - shuffle(q[0, 0], left)) + (q[1, 0] - shuffle(q[1, rows - 1], above))
        norm = d * d
        v = d - g[0] * inverse
        v_next_strip = shuffle(v, below)
        full = float32(step)
        x_step, y_step = full * in_row, full * in_last
        for r in range(rows):
            v_below = v_next_strip
            if r < rows - 1:
                d = (q[0, r + 1] - shuffle(q[0, r + 1], left)) + (q[1, r + 1] - q[1, r])
                norm += d * d
                v_below = d - g[r + 1] * inverse
            step_x = x_step * (shuffle(v, right) - v)
            step_y = (full if r < last else y_step) * (v_below - v)
            advance(q, p, r, step_x, step_y, momentum)
            v = v_below
        return norm

    return sweep


def make_divergence(strips: Strips) -> Any:
    """Return the function that computes div p of this thread's pixels, into (rows,)."""
    rows, nx, mask = strips.rows, strips.nx, WARP - 1

    @device
    def divergence(p: Any, lane: Any, d: Any) -> None:
        left, above = (lane - 1) & mask, (lane - nx) & mask
        y_above = shuffle(p[1, rows - 1], above)
        for r in range(rows):
            d[r] = (p[0, r] - shuffle(p[0, r], left)) + (p[1, r] - y_above)
            y_above = p[1, r]

    return divergence


def make_change(strips: Strips, algorithm: bool | None) -> Any:
    """Return the convergence test: ||div p - div previous p||^2 <= tolerance^2 ||div p - g / lambda||^2."""
    rows = strips.rows
    divergence = make_divergence(strips)
    fgp = algorithm is FGP

    @device
    def has_converged(q: Any, p: Any, g: Any, lane: Any, inverse: Any, momentum: Any, tolerance: Any) -> Any:
        of_q, of_p = cuda.local.array(rows, float32), cuda.local.array(rows, float32)
        divergence(q, lane, of_q)
        divergence(p, lane, of_p)
        change = size = float32(0.0)
        for r in range(rows):
            move = of_q[r] - of_p[r]  # momentum times what the last iteration changed; chambolle: that itself
            change += move * move
            v = (of_p[r] if fgp else of_q[r]) - g[r] * inverse
            size += v * v
        bound = tolerance * momentum if fgp else tolerance
        return warp_total(change) <= bound * bound * warp_total(size)

    return has_converged


def make_iterations(strips: Strips, algorithm: bool | None) -> Any:
    """Return the function that iterates on p and q until the image has converged or the limit is reached."""
    sweep, has_converged = make_sweep(strips, algorithm), make_change(strips, algorithm)
    divergence, rows, chambolle = make_divergence(strips), strips.rows, algorithm is CHAMBOLLE

    @device
    def iterate(
        q: Any,
        p: Any,
        g: Any,
        lane: Any,
        in_row: Any,
        in_last: Any,
        inverse: Any,
        age: Any,
        radius: Any,
        tolerance: Any,
        limit: Any,
    ) -> Any:
        """`inverse`: 1 / lambda; `age`: the momentum's. Return the iterations and whether they converged."""
        inverse_radius = float32(1.0) / radius
        momentum = float32(0.0)
        converged, check_after = False, float32(CHECK_INTERVAL)
        iteration, last, until_check = float32(0.0), float32(limit), check_after  # no 64-bit integers
        while iteration < last and not converged:
            iteration += float32(1.0)
            until_check -= float32(1.0)
            # A sweep extrapolates for the next one: its momentum.
            age, momentum = next_momentum(age)
            norm = sweep(q, p, g, lane, in_row, in_last, inverse, momentum)
            if chambolle:  # with the old norm the multiplier would oscillate
                norm = float32(0.0)
                d = cuda.local.array(rows, float32)
                divergence(q, lane, d)
                for r in range(rows):
                    norm += d[r] * d[r]
            norm = warp_total(norm)
            if norm > float32(0.0):
                inverse = norm * inverse_root(norm) * inverse_radius
            if until_check == float32(0.0) or iteration >= last:
                until_check = check_after
                if tolerance > float32(0.0):
                    converged = has_converged(q, p, g, lane, inverse, momentum, tolerance)
        return int32(iteration), converged

    return iterate


def make_normalise(strips: Strips) -> Any:
    """Return the function that writes (image - mean) / scale to g, 0 where there is no pixel."""
    rows, pixels = strips.rows, strips.ny * strips.nx

    @device
    def normalise(image: Any, present: Any, g: Any) -> Any:
        """Return mean, scale (0 for a constant image) and sum of squares of g."""
        total, low, high = float32(0.0), float32(math.inf), float32(-math.inf)
        for r in range(rows):
            if r < present:
                total += image[r]
                low, high = min(low, image[r]), max(high, image[r])
        mean = warp_total(total) / float32(pixels)
        low, high = smallest(low), largest(high)
        scale = max(high - mean, mean - low) if high - low > float32(SMALLEST_RANGE) else float32(0.0)
        inverse = float32(1.0) / scale if scale > float32(0.0) else float32(1.0)
        squares = float32(0.0)
        for r in range(rows):
            g[r] = (image[r] - mean) * inverse if r < present else float32(0.0)
            squares += g[r] * g[r]
        return mean, scale, warp_total(squares)

    return normalise


def make_denoise(strips: Strips, algorithm: bool | None) -> Any:
    """Return the function that denoises an image, (rows,) per thread, in place."""
    rows, pixels = strips.rows, strips.ny * strips.nx
    normalise, divergence = make_normalise(strips), make_divergence(strips)
    start, iterate = make_start_flat(strips), make_iterations(strips, algorithm)
    chambolle = algorithm is CHAMBOLLE

    @device
    def denoise(
        image: Any,
        lane: Any,
        present: Any,
        in_row: Any,
        in_last: Any,
        strength: Any,
        tolerance: Any,
        limit: Any,
        plane: Any,
        pivots: Any,
    ) -> Any:
        """`plane` and `pivots`: see `make_laplace`.

        Return the number of iterations, and whether they converged and the strength was too strong.
        """
        g = cuda.local.array(rows, float32)
        mean, scale, squares = normalise(image, present, g)
        if scale <= float32(0.0):
            return int32(0), True, strength > float32(0.0)
        relative = strength / scale
        if relative <= float32(SMALLEST_STRENGTH):
            return int32(0), True, False
        radius = math.sqrt(float32(pixels)) * relative
        norm = math.sqrt(squares)
        lowered = radius > float32(HIGHEST_STRENGTH) * norm
        if lowered:
            radius = float32(LOWERED_STRENGTH) * norm
        if limit <= 0:
            return int32(0), False, lowered
        p, q = cuda.local.array((2, rows), float32), cuda.local.array((2, rows), float32)
        inverse = start(g, plane, pivots, lane, present, in_row, in_last, radius, p, q)
        iterations, converged = iterate(
            q, p, g, lane, in_row, in_last, inverse, float32(MOMENTUM_AGE), radius, tolerance, limit
        )
        d = cuda.local.array(rows, float32)
        if chambolle:
            divergence(q, lane, d)
        else:
            divergence(p, lane, d)
        squares = float32(0.0)
        for r in range(rows):
            squares += d[r] * d[r]
        squares = warp_total(squares)
        multiplier = radius / math.sqrt(squares) if squares > float32(0.0) else float32(0.0)
        for r in range(rows):
            image[r] = mean + scale * (g[r] - multiplier * d[r])
        return iterations, converged, lowered

    return denoise
