"""Settings and estimators that change while the engine runs."""
