"""The estimators; those that share steps share a module."""
