"""Proof of stability: the extremes, and what each law promises there.

`python -m stability` (from tests/) runs the cases against a daemon and writes results/<backend>.json;
`python -m stability.report` makes docs/stability.md of those files. `make stability` does both. Meshes, laws and the
driver are those of tests/accuracy.

A new shape or law comes with `accuracy.meshes.SHAPES` and `tissue.tissue`; the rows follow. A law's promise is an entry
in `promises.PROMISES`.
"""
