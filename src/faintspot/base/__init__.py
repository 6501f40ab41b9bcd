"""Errors, checks and files that every other package builds on."""
