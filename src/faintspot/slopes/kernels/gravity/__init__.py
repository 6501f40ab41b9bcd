"""Background subtraction and centre of gravity."""
