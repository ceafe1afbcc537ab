"""Proof of stability: the extremes, and what each law promises there.

`python -m stability` (from tests/) runs the cases against a daemon and writes results/<backend>.json.
`python -m stability.report` makes docs/stability.md, results/rows.csv and results/README.md from those files.
`make stability` does both. Meshes, laws and the driver come from tests/accuracy.

To add a shape or law, add it to `accuracy.meshes.SHAPES` or `tissue.tissue`; its rows follow. A law's promise is an
entry in `promises.PROMISES`.
"""
