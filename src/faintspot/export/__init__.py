"""Settings as the files that other controllers read: one module a kind of controller."""

from faintspot.export.darc import export_darc
from faintspot.export.weights import export_weights

__all__ = ["export_darc", "export_weights"]
