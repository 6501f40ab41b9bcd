"""Control: from slopes to commands. Plain objects that know nothing of a simulation."""
