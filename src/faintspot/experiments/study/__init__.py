"""Monte-Carlo studies: specification, cells, runs, curves."""
