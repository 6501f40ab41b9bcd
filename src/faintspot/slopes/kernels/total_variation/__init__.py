"""Total-variation denoising of groups of sub-apertures."""
