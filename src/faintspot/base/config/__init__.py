"""Options, tables and presets of a configuration."""
