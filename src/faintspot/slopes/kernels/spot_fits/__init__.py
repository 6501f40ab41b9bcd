"""Fits of a spot model: likelihood, posterior, weights."""
