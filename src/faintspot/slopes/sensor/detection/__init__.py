"""Detection of the lenslets in a frame: spots, lattice, illumination."""
