"""Measurements from the telemetry of loops. Read in this order.

`recorded_loop` (a loop of any system from its file), `spectra` (also of what slopes cannot show), `choices`
(other controllers by replay), `scintillation` (of the fluxes), `report`, `page`. `recording` prepares
telemetry of this engine for learning; `engine_sections` are those that only its recordings have. Of methods
that alternated, `alternation` gives the residual phase of each turn and their centroid gains, `turns` their
differences turn by turn.
"""
