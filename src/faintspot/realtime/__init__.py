"""The engine between camera and reconstructor: pixels stream in by rows, slopes stream out."""
