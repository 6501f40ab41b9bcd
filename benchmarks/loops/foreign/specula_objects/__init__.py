"""Objects that SPECULA finds by the name of their file."""
