"""Statistics of von Karman turbulence."""
