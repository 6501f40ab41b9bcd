"""What is compiled: sub-apertures in SIMD lanes. Read in this order.

How kernels are compiled: `compiling`, `host` (the processor), `simd` (vector types), `ordered` (memory
shared by processes). From a frame to slopes: `gather`, `groups` (one driver for all estimators), `streaming`
(while rows arrive), `parallel`, `dark` and `doubtful` (validity), `products` (matrices). Centres of gravity:
`brightest` (and smoothing), `gravity`, `window`. Fits of a spot model: `spot_rows`, `likelihood`, `means`,
`fits`. Total variation: `sweeps`, `flat_start`, `denoise`.
"""
