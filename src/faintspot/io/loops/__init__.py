"""Loops that other systems recorded: tables and save files of observatories, milk, pyRTC, folders."""
