"""Models of spots. Read in this order.

`shapes` (noiseless spots), `speckled`, `psf`, `sodium` and `laser` (elongated spots),
`fixed_weights` (linear estimator), `bounds` (Cramer-Rao bound).
"""
