"""Lines for a configuration of DARC whose slope module is faintspot's; `layout` is that of faintspot.toml.

DARC's configuration files are Python and fill a dictionary `control`; these functions give its entries.
"""

import numpy as np


def path_as_integers(path):
    """Return a path as slopeParams: whole int32."""
    raw = str(path).encode()
    return np.frombuffer(raw + bytes(-len(raw) % 4 or 4), np.int32)


def pixel_counts(layout, width):
    """Return pxlCnt: the pixels after which each sub-aperture's group of `width` is there.

    DARC hands consecutive sub-apertures with the same number to a module in one call; each group has its own.
    """
    last, (height, line) = layout.corners[:, 0] + layout.window[0], layout.frame_shape
    ends = np.array([last[k : k + width].max() for k in range(0, len(last), width)]) * line
    apart = np.arange(len(ends)) - len(ends)
    counts = np.minimum(np.maximum.accumulate(ends + apart), height * line)
    return np.repeat(counts, width)[: len(last)].astype(np.int32)


def slope_module(layout, module, bundle, width=8, images=False):
    """Return DARC's parameters for the module; `width` as `faintspot_describe` has it."""
    rows = {} if images else {"pxlCnt": pixel_counts(layout, width)}
    return {
        **rows,
        "slopeName": str(module),
        "slopeParams": path_as_integers(bundle),
        "fsImages": np.int32(images),
        "calibrateOpen": np.int32(images),
    }
