"""What all comparisons of methods share: arms, choosing, units of work, their store, statistics, curves."""
