"""A web page that shows a running engine or a recording."""
