"""The command `loop`."""
