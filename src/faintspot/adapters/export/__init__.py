"""Export of settings to files of other controllers: one module per kind of controller."""

from faintspot.adapters.export.darc import export_darc
from faintspot.adapters.export.weights import export_weights

__all__ = ["export_darc", "export_weights"]
