"""Page of a study: `page`, `estimator_figures`, and `efficiency` (tables and findings)."""
