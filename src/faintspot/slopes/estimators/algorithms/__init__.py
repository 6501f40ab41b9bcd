"""Functions that process stacks of sub-aperture images."""
