"""Basden et al. (2015): claims and their verdicts (`claims`, `judges`), figures and tables."""
