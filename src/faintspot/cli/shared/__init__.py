"""Code shared by all commands: options, messages, progress, output."""
