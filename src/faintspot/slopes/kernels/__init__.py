"""What is compiled: sub-apertures in SIMD lanes. Read in this order.

How kernels are compiled: `compiling`, `host` (the processor), `simd` (vector types), `ordered` (memory
shared by processes). From a frame to slopes: `gather`, `groups` (one driver for all estimators), `streaming`
(while rows arrive), `parallel`, `validity`, `products` (matrices). Estimators: `positions` (centres of
gravity, weights, fits of a spot model), `total_variation`.
"""
