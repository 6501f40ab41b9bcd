"""Settings and estimators that change while the engine runs. Read in this order.

`interleaving` (configurations in turn), `plan` (settings prepared for a frame), `running_settings` (changes
between frames), `following` (of flux and dark sub-apertures), `estimators` (files of the user).
"""
