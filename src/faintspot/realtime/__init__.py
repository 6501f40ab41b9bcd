"""The engine between camera and reconstructor: reads pixels row by row and publishes slopes."""
