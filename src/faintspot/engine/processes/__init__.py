"""Child processes, shared memory, and requests to a running engine."""
