"""Prediction of slopes, and its fallback. Read in this order.

`slope_model` (second-order autoregression), `predictor` (its Kalman filter), `predictive` (commands from
predicted slopes), `guarded` (filter and integrator side by side), `kernels` and `compiled` (the same,
compiled). For large sensors: `local_model`, `local_covariance`, `local_predictor`, `large_guarded`.
"""
