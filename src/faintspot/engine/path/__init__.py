"""Path of one frame from rows of pixels to slopes. Read in this order.

`frame_path` (compiled estimators), `workers` (its threads, and predicted slopes), `python_path`
(estimators in NumPy) and `timing` (statistics).
"""
