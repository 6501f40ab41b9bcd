"""Python files with an estimator, "mine", for a running engine to load."""

from pathlib import Path
from textwrap import dedent, indent

_TEXT = """\
import ctypes, os, time
from dataclasses import dataclass
from typing import Any
import numpy as np
from faintspot.slopes.estimators import Estimator, option, register
{top}
@register
@dataclass(frozen=True, eq=False, kw_only=True)
class Mine(Estimator):
    share: Any = option(1.0, "Share.", low=0.0, high=9.0, per_subaperture=False)
    name = "mine"
    label = "mine"
    def locate(self, images, sensor, prior):
{body}
"""
PEAK = """
n, ny, nx = images.shape
row, column = np.divmod(images.reshape(n, -1).argmax(axis=1), nx)
return self.share * np.column_stack([column - (nx - 1) / 2, row - (ny - 1) / 2])
"""


def write(folder: Path, body: str = PEAK, top: str = "", name: str = "my_estimator") -> Path:
    """Write a file whose estimator's `locate` has this body."""
    path = folder / f"{name}.py"
    path.write_text(_TEXT.format(top=dedent(top), body=indent(dedent(body), 8 * " ")))
    return path
