"""Which slopes are valid."""
