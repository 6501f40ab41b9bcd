"""How every picture is drawn, and one self-contained page (HTML) made of sections.

The content of a page belongs to its subject: `faintspot.recorded` for slopes, and each experiment.
"""
