"""The command `layout`."""
