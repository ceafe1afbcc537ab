"""Readers of mesh files, one file a format.

They run in a child process (`child.py`), which must start quickly. So nothing here imports the rest of the SDK, but
for small files without imports of their own.
"""
