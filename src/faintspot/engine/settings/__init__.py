"""Settings that change between frames. Read in this order.

`interleaving` (configurations in turn), `running_settings`, `plan` (what is prepared for a frame),
`estimators` (files of the user).
"""
