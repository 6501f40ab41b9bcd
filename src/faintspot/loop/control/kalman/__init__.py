"""Prediction of slopes, and its fallback. Read in this order.

`predictor` (second-order autoregression and its Kalman filter), `guarded` (filter and integrator side by
side), `kernels` and `compiled` (the same, compiled). For large sensors, as small ones lose by it:
`local_model`, `local_predictor`. Of modes without geometry: `modal_predictor`, with the guard of large
sensors.
"""
