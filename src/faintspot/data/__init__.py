"""Example frame of a real sensor, shipped with the package."""

from importlib.resources import files

import numpy as np
from numpy.typing import NDArray


def mmt_frame() -> NDArray[np.uint16]:
    """Return an on-sky frame with faint spots, hot pixels and an annular pupil.

    On-sky frame of the active-optics sensor of the MMIRS spectrograph at the 6.5 m MMT (15 April 2017): a
    square array of 14 lenslets across, 22 px apart. Cropped to the pupil.

    Returns
    -------
    ndarray, uint16, shape (rows, columns)
        Frame [ADU]. Dark level and gain are unknown.

    Notes
    -----
    Source: mmirs_wfs_0150.fits of the test data of mmtwfs (https://github.com/MMTObservatory/mmtwfs),
    Copyright (c) 2018, MMT TelescopeModel, BSD-3-Clause; its licence is LICENSE_mmtwfs.rst beside the data.

    Examples
    --------
    >>> from faintspot.data import mmt_frame
    >>> frame = mmt_frame()
    >>> frame.dtype.name, frame.ndim
    ('uint16', 2)
    """
    with (files(__name__) / "mmirs_wfs_0150.npz").open("rb") as file, np.load(file) as stored:
        frame: NDArray[np.uint16] = stored["frame"]
    return frame
