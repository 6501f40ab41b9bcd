"""Denoising by constrained total variation: `sweeps` (an iteration), `flat_start`, `denoise`."""
