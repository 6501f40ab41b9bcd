"""The report of recorded slopes: sections, maps, key numbers, advice."""
