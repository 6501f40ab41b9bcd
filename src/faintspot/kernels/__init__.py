"""The same work as faintspot.estimate, fast: sub-apertures in SIMD lanes."""
