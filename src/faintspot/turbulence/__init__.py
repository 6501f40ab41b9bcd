"""Statistics of von Karman turbulence, as theory has them."""
