"""Measurements from recorded loops."""
