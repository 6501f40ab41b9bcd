"""Spot models, point-spread functions, trained scores and the Cramer-Rao bound."""
