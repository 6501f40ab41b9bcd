"""The estimators, one in each file."""
