"""The slope pipeline in SPECULA (Rossi et al. 2024, Proc. SPIE 13097), as a class of its parameter files.

::

    main:
      add_modules: [faintspot.adapters.specula]
    slopec:
      class: FaintspotSlopec

SPECULA looks for a class in the file of its name, `faintspot_slopec.py`.
"""
