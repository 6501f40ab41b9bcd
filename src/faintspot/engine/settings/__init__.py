"""Settings and estimators that change while the engine runs. Read in this order.

`interleaving` (configurations in turn), `running_settings` (changes between frames), `plan` (settings
prepared for a frame; running means of flux and dark windows), `estimators` (files of the user).
"""
