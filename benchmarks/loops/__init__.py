"""From slopes to commands."""
