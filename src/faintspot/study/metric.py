"""Statistics of slopes, under the name that scripts know; they live in `faintspot.compare.statistics`."""

from faintspot.compare.statistics import absolute_errors, slope_error, slope_statistics

__all__ = ["absolute_errors", "slope_error", "slope_statistics"]
