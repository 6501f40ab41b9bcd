"""Models of spots. Read in this order.

`shapes` (noiseless spots), `speckled`, `psf`, `sodium` and `laser` (elongated spots), `score` and
`fixed_weights` (linear estimators), `bounds` (Cramer-Rao bound).
"""
