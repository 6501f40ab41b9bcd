"""Controllers that turn slopes into mirror commands, independent of any simulation."""
