"""How kernels are compiled: SIMD types, processor, disk cache, memory order."""
