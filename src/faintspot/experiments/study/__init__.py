"""Monte-Carlo studies of the slope error. Read in this order.

`sweep` (cells), `specification` (a study), `cell_methods` and `cell` (one cell), `run` (all of them),
`curves` (errors against flux); the shipped studies are in `studies`.
"""
