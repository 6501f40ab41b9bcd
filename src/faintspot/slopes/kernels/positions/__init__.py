"""Positions of spots. Read in this order.

Centres of gravity: `brightest` (and smoothing), `gravity`, `window`. Fits of a spot model: `spot_rows`,
`likelihood`, `means`, `fits`.
"""
