"""Basden et al. (2015): claims and their verdicts, figures and tables.

`claims` and `judges` (of the Monte-Carlo figures), `figures`, and `whole` (tables, and every figure and table
of the paper in one, the night of `experiments.night` included).
"""
