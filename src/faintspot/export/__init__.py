"""Export of settings to files of other controllers: one module per kind of controller."""

from faintspot.export.darc import export_darc
from faintspot.export.weights import export_weights

__all__ = ["export_darc", "export_weights"]
