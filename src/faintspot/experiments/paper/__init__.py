"""Basden et al. (2015): claims and their verdicts, figures and tables.

`claims` and `judges` (of the Monte-Carlo figures), `tables` and `figures`, `whole` (every figure and table,
the night of `experiments.night` included, in one table).
"""
