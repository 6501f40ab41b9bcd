"""Page of a study."""
