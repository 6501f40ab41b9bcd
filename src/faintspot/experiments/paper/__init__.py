"""Basden et al. (2015): claims, verdicts, figures and tables."""
