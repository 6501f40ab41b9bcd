"""Adapters: the slope pipeline as a part of other adaptive-optics tools, one module a tool.

Each takes a tool's image, the sub-apertures from the tool's own description of its sensor, and returns slopes
in the tool's own unit and order; `faintspot.adapters.base` holds what they share.
"""
