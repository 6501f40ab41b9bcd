"""Adapters that use the slope pipeline in other adaptive-optics tools, one module per tool.

Each takes a tool's image and its description of the sub-apertures, and returns slopes in the tool's unit and
order. `faintspot.adapters.base` holds the common parts.
"""
