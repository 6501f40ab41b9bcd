"""Fast versions of `estimators.algorithms` and of the estimators: sub-apertures in SIMD lanes."""
