"""Streams that other software reads or writes: images, slopes, commands."""
