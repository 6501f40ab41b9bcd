"""faintspot without Python: a C library from a configuration.

`folder` writes it; `objects` compiles kernels to object files, `bundle` puts tables into a file; `runtime`
has the part in C.
"""
