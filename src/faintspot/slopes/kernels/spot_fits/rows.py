"""Images of a group one after the other, in rows of whole vectors, instead of side by side in lanes.

For work in which every sub-aperture needs numbers of its own for each pixel: then a vector holds W pixels of
a row. Rows are filled up with zeros.
"""

from __future__ import annotations

from typing import Any

from faintspot.slopes.kernels.compilation.compiling import compiled
from faintspot.slopes.kernels.compilation.simd import copy_transposed, splat, store, width_of


@compiled
def rows_from_lanes(lanes: Any, image: Any, ny: Any, nx: Any, starts: Any, rows: Any) -> None:
    """Reorder a group's images.

    Parameters
    ----------
    image : (>= ny * nx * W + W,)
        All lanes of a pixel side by side.
    starts : (W,) int64
        Scratch.
    rows : (ny, n_vectors, W, W)
        Written: pixel `vector * W + i` of a row of sub-aperture `lane` is at [row, vector, lane, i].
    """
    width = width_of(lanes)
    vectors = rows.shape[1]
    nothing = ny * nx * width
    store(image, nothing, splat(lanes, 0.0))
    for vector in range(vectors):
        first = vector * width
        whole = first + width <= nx
        for i in range(width):
            starts[i] = (first + i) * width
        for y in range(ny):
            shift = y * nx * width
            if not whole:
                for i in range(nx - first, width):
                    starts[i] = nothing - shift
            copy_transposed(lanes, image, starts, shift, rows, (y * vectors + vector) * width * width)
