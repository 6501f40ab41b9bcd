"""Prediction: Kalman filters of all slopes or of neighbours, and their guards."""
