"""Layout of the sub-apertures, and methods that find them in frames."""
