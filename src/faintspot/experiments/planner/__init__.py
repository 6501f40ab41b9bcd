"""The planner: which estimator and settings for a camera and a star."""
