"""The engine, and other real-time software."""
