"""The command `realtime`, one file for each of its own, and `live`."""
