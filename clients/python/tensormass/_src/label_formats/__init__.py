"""Readers of label maps (segmentations), one file a format. They run in the child process of mesh_formats."""
