"""What is faster than what, and by how much: run by hand, `python -m benchmarks`; never a timed test."""
