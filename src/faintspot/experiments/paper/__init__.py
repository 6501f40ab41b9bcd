"""Basden et al. (2015): claims and their verdicts, figures and tables.

`judges` (of the Monte-Carlo figures), `claims` (tables, and every figure and table of the paper in one, the
night of `experiments.night` included), `figures`, `loop_map`.
"""
