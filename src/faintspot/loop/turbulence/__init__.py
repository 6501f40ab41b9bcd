"""Statistics of von Karman turbulence: covariances of slopes, and r0 and outer scale from slopes."""
