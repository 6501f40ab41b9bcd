"""A web page of the running engine, or of a recording."""
