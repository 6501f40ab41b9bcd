"""Fast versions of `faintspot.algorithms` and of the estimators: sub-apertures in SIMD lanes."""
