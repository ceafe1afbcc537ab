"""Proof of accuracy: every shape and law against solvers and formulas that share no code with the server.

`python -m accuracy` (from tests/) runs the cases against a daemon and writes results/<backend>.json.
`python -m accuracy.report` makes docs/accuracy.md and the CSV files of those results. `make accuracy` does both.

A new shape is one entry in `meshes.SHAPES`, a new law one entry in `laws.LAWS`. Their rows follow from that.
"""
