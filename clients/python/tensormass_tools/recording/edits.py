"""Edits of a scene in a recording, in words. server/world/edits.h has the list."""

from __future__ import annotations

#: What a mark says of each edit, by its name in RecordedEdit.
TEXTS = {
    "adjust": "Values of the scene were adjusted.",
    "restore": "A snapshot was restored.",
    "reset": "The scene was reset.",
    "scene_edit": "Tissue was ablated or springs were severed.",
}
