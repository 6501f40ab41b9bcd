"""The planner: which estimator and settings suit a camera and a star. Read in this order.

`question` (camera and star), `recorded` (the same from frames), `simulated` (spots to choose settings on),
`tuning` (the choice), `promise` (its check on recorded frames), `answer` and `text` (with its
figure).
"""
