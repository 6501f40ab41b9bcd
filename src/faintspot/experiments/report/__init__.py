"""Page of a study: `page`, and `estimators` for one that compares estimators."""
