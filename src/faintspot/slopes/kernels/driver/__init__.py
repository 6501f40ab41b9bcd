"""From a frame to groups of sub-apertures and back, whole or while rows arrive."""
