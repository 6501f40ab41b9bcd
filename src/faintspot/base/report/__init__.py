"""Drawing of figures, and self-contained HTML pages made of sections.

The content of a page belongs to its subject: `faintspot.slopes.recorded` for slopes, and each experiment.
"""
