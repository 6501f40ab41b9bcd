"""What is done to a stack of sub-aperture images, as plain functions."""
