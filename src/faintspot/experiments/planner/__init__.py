"""The planner: which estimator and settings suit a camera and a star. Read in this order.

`stated` and `question` (camera and star; spots to choose settings on), `recorded` (the same from frames),
`tuning` (the choice), `promise` (its check on recorded frames), `answer` and `text` (with its figure).
"""
