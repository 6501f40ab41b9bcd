"""Positions of images for every number of kept pixels at once, a warp per image.

As `faintspot.kernels.scoring`: the pixels are sorted, then summed up in double precision. Here every pixel's
rank is the number of those that go before it.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from numba import cuda, float32, float64, int32

from faintspot.cuda.brightest import make_extremes
from faintspot.cuda.compiling import device, kernel
from faintspot.cuda.flat_start import pitch_of
from faintspot.cuda.gather import make_recall, make_share, make_smooth
from faintspot.cuda.median import make_median
from faintspot.cuda.strips import WARP, Strips, strips_of
from faintspot.cuda.total_variation import make_denoise
from faintspot.cuda.warp import synchronise, total
from faintspot.kernels.scoring import THRESHOLD
from faintspot.kernels.total_variation import FGP

NOTHING, DENOISE, SMOOTH, MEDIAN = range(4)
"""What is done to an image before its brightest pixels are kept."""

ERROR, ERROR_SQUARED, X, Y, SQUARES, ACROSS = range(6)
"""Rows of `sums_kernel`: of R's terms, their squares, x, y, x^2 + y^2, and the product with the truth."""

warp_total = total


def make_sort(strips: Strips) -> Any:
    """Return the function that sorts pixels by falling value; ties keep their order."""
    rows, ny, nx = strips.rows, strips.ny, strips.nx

    @device
    def sort(image: Any, tile: Any, first: Any, present: Any, values: Any, order: Any) -> None:
        """`tile`: the image as all threads see it; `first`: number of the thread's first pixel."""
        ranks = cuda.local.array(rows, int32)
        for r in range(rows):
            ranks[r] = int32(0)
        for y in range(ny):
            for x in range(nx):
                other, number = tile[y, x], int32(y * nx + x)
                for r in range(rows):
                    before = other > image[r] or (other == image[r] and number < first + r * nx)
                    ranks[r] += int32(1) if before else int32(0)
        for r in range(rows):
            if r < present:
                values[ranks[r]] = image[r]
                order[ranks[r]] = first + r * nx
        synchronise()

    return sort


def make_sums(strips: Strips) -> Any:
    """Return the function that adds a pixel to the sums of g, g x, g y, x and y."""
    nx = strips.nx
    middle_x, middle_y = 0.5 * (strips.nx - 1), 0.5 * (strips.ny - 1)

    @device
    def add(sums: Any, value: Any, number: Any) -> None:
        g = float64(value)
        x, y = float64(number % nx) - middle_x, float64(number // nx) - middle_y
        sums[0] += g
        sums[1] += g * x
        sums[2] += g * y
        sums[3] += x
        sums[4] += y

    return add


def make_locate_every_k(strips: Strips, rule: int) -> Any:
    """Return the function that writes the positions of an image whose pixels are sorted."""
    pixels = strips.ny * strips.nx
    share = -(-pixels // WARP)
    add, with_ties = make_sums(strips), rule == THRESHOLD

    @device
    def add_up(sums: Any, values: Any, order: Any, lane: Any, shares: Any) -> None:
        """Sum the pixels before the thread's share; `shares` (5, 32) are for all threads."""
        for q in range(5):
            sums[q] = 0.0
        for i in range(lane * share, min((lane + 1) * share, pixels)):
            add(sums, values[i], order[i])
        for q in range(5):
            shares[q, lane] = sums[q]
            sums[q] = 0.0
        synchronise()
        for other in range(lane):
            for q in range(5):
                sums[q] += shares[q, other]

    @device
    def locate_every_k(
        values: Any,
        order: Any,
        lane: Any,
        shares: Any,
        floor: Any,
        reach: Any,
        at: Any,
        positions: Any,
        valid: Any,
    ) -> None:
        sums, extended = cuda.local.array(5, float64), cuda.local.array(5, float64)
        add_up(sums, values, order, lane, shares)
        largest = max(abs(values[0]), abs(values[pixels - 1]))
        for k in range(lane * share + 1, min((lane + 1) * share, pixels - 1) + 1):
            add(sums, values[k - 1], order[k - 1])
            for q in range(5):
                extended[q] = sums[q]
            threshold = float64(values[k])
            if with_ties:  # those that equal the k-th stay whole
                threshold, i = float64(0.0), k
                while i < pixels and values[i] == values[k - 1]:
                    add(extended, values[i], order[i])
                    i += 1
            left = extended[0] - float64(k) * threshold
            lit = left > floor * float64(largest) and left > 0.0
            inverse = 1.0 / left if lit else 0.0
            x = (extended[1] - threshold * extended[3]) * inverse
            y = (extended[2] - threshold * extended[4]) * inverse
            positions[k - 1, at, 0] = min(max(x, -reach), reach)
            positions[k - 1, at, 1] = min(max(y, -reach), reach)
            valid[k - 1, at] = 1 if lit else 0

    return locate_every_k


@cache
def positions_kernel(side: int, before: int, rule: int) -> Any:
    """Return the kernel that writes positions (K, n, 2) float32 and validity (K, n) uint8 of n images.

    One warp a block, one block an image; K = side^2 - 1.

    Raises
    ------
    InputError
        When the images are too large for a warp.
    """
    strips = strips_of((side, side))
    rows, threads, last, pixels = strips.rows, strips.threads, strips.strips - 1, side * side
    pitch, flat_rows = pitch_of(side), side if before == DENOISE else 1
    share, recall, smooth = make_share(strips), make_recall(strips), make_smooth(strips)
    median, denoise = make_median(strips), make_denoise(strips, FGP)
    sort, locate_every_k = make_sort(strips), make_locate_every_k(strips, rule)

    @kernel
    def locate(
        images: Any,
        strength: Any,
        tolerance: Any,
        limit: Any,
        pivots: Any,
        taps: Any,
        floor: Any,
        reach: Any,
        positions: Any,
        valid: Any,
    ) -> None:
        """`images` (n, side, side); inverse `pivots` (side^2,) of the denoising; `taps` (2, 1 + reach)."""
        at, lane = cuda.blockIdx.x, cuda.threadIdx.x
        if at >= images.shape[0]:
            return
        strip, column = lane // side, lane % side
        top = strip * rows
        present = min(rows, side - top) if lane < threads else 0
        planes = cuda.shared.array((2, side, side), float32)
        tile, scratch = planes[0], planes[1]
        plane = cuda.shared.array((flat_rows, pitch), float32)
        image = cuda.local.array(rows, float32)
        recall(images[at], top, column, present, image)
        if before == DENOISE:
            in_row = float32(1.0) if lane < threads and column < side - 1 else float32(0.0)
            in_last = float32(1.0) if strip < last else float32(0.0)
            denoise(image, lane, present, in_row, in_last, strength, tolerance, limit, plane, pivots)
        elif before == SMOOTH:
            smooth(images[at], taps, lane, scratch, tile)
            recall(tile, top, column, present, image)
        elif before == MEDIAN:
            median(images[at], top, column, present, image)
        share(image, top, column, present, tile)
        values = cuda.shared.array(pixels, float32)
        order = cuda.shared.array(pixels, int32)  # the simulator tells arrays by their lines
        shares = cuda.shared.array((5, WARP), float64)
        sort(image, tile, top * side + column, present, values, order)
        locate_every_k(values, order, lane, shares, floor, reach, at, positions, valid)

    return locate


@cache
def thresholded_kernel(side: int) -> Any:
    """Return the kernel for the centre of gravity above a threshold: as `positions_kernel`, K = 1."""
    strips = strips_of((side, side))
    rows, threads, middle = strips.rows, strips.threads, 0.5 * (side - 1)
    recall, extremes = make_recall(strips), make_extremes(strips)

    @kernel
    def locate(images: Any, threshold: Any, floor: Any, reach: Any, positions: Any, valid: Any) -> None:
        at, lane = cuda.blockIdx.x, cuda.threadIdx.x
        if at >= images.shape[0]:
            return
        column, top = lane % side, lane // side * rows
        present = min(rows, side - top) if lane < threads else 0
        image = cuda.local.array(rows, float32)
        recall(images[at], top, column, present, image)
        low, high, _ = extremes(image, present)
        light, moment_y = float32(0.0), float32(0.0)
        for r in range(rows):
            if r < present:
                left = max(image[r] - threshold, float32(0.0))
                light += left
                moment_y += left * (float32(top + r) - float32(middle))
        moment_x = warp_total(light * (float32(column) - float32(middle)))
        light, moment_y = warp_total(light), warp_total(moment_y)
        lit = light > floor * max(abs(low), abs(high))
        inverse = float32(1.0) / light if lit else float32(0.0)
        if lane == 0:
            positions[0, at, 0] = min(max(moment_x * inverse, -reach), reach)
            positions[0, at, 1] = min(max(moment_y * inverse, -reach), reach)
            valid[0, at] = 1 if lit else 0

    return locate


@cache
def sums_kernel() -> Any:
    """Return the kernel that sums over the images, (6, K) float64, always in the same order.

    One warp a block, one block for each k.
    """

    @kernel
    def sum_up(positions: Any, truth: Any, sums: Any) -> None:
        """`positions` (K, n, 2) float32, `truth` (n, 2) float64."""
        k, lane = cuda.blockIdx.x, cuda.threadIdx.x
        if k >= positions.shape[0]:
            return
        parts = cuda.shared.array((6, WARP), float64)
        own = cuda.local.array(6, float64)
        for q in range(6):
            own[q] = 0.0
        for i in range(lane, positions.shape[1], WARP):
            x, y = float64(positions[k, i, 0]), float64(positions[k, i, 1])
            error = 0.5 * (abs(x - truth[i, 0]) + abs(y - truth[i, 1]))
            own[ERROR] += error
            own[ERROR_SQUARED] += error * error
            own[X] += x
            own[Y] += y
            own[SQUARES] += x * x + y * y
            own[ACROSS] += x * truth[i, 0] + y * truth[i, 1]
        for q in range(6):
            parts[q, lane] = own[q]
        synchronise()
        if lane < 6:
            whole = float64(0.0)
            for other in range(WARP):
                whole += parts[lane, other]
            sums[lane, k] = whole

    return sum_up
