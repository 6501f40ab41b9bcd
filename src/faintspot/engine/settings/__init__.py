"""Settings and estimators that change while the engine runs. Read in this order.

`interleaving` (configurations in turn), `plan` (settings prepared for a frame), `running_settings` (changes
between frames), `flux_following`; `estimator_file`, `estimator_trial` and `estimators` (files of the user).
"""
