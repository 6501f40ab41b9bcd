"""From frames to slopes."""
