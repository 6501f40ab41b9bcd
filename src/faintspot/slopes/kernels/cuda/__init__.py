"""Kernels for an NVIDIA GPU: the work of `kernels.gravity.gravity`, a warp of 32 threads per sub-aperture.

`SlopePipeline(..., device="cuda")` measures frames in the memory of the host with them,
`pipeline.device` frames on the GPU, `faintspot.slopes.pipeline.device_stream` frames as they arrive.

Needs the extra `gpu` and a GPU, or NUMBA_ENABLE_CUDASIM=1 in the environment before Numba is imported:
Numba's CUDA simulator then runs the same code, slowly, on the CPU.
"""
