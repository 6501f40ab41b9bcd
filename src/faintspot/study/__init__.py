"""How large the slope error is, and what a method gains: Monte-Carlo experiments with a known truth."""
