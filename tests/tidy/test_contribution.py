"""The files that a code host and other people's programs read: forms, citation, development container."""

from __future__ import annotations

import json
import os
import shlex
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
FORMS = sorted((ROOT / ".github/ISSUE_TEMPLATE").glob("*.yml"))
#: Kinds of fields that a form may have.
FIELDS = {"checkboxes", "dropdown", "input", "markdown", "textarea"}


def read(name: str) -> dict[str, Any]:
    return yaml.safe_load((ROOT / name).read_text("utf-8"))


@pytest.mark.parametrize("form", [form for form in FORMS if form.stem != "config"], ids=lambda form: form.stem)
def test_a_form_has_what_a_code_host_requires(form: Path) -> None:
    content = read(str(form))
    assert content["name"]
    assert content["description"]
    fields = content["body"]
    assert {field["type"] for field in fields} <= FIELDS
    assert all(field["attributes"]["label"] for field in fields)
    names = [field["id"] for field in fields]
    assert len(set(names)) == len(names) > 0


def test_there_are_forms_for_both_kinds_of_issues() -> None:
    assert {form.stem for form in FORMS} == {"bug", "config", "idea"}


def test_the_citation_names_the_version_and_licence_of_the_package() -> None:
    citation = read("CITATION.cff")
    package = tomllib.loads((ROOT / "clients/python/pyproject.toml").read_text("utf-8"))["project"]
    assert (citation["version"], citation["license"]) == (package["version"], package["license"])
    assert {"cff-version", "message", "title", "authors"} <= set(citation)


def test_the_development_container_calls_the_set_up() -> None:
    container = json.loads((ROOT / ".devcontainer/devcontainer.json").read_text("utf-8"))
    script, goal = shlex.split(container["postCreateCommand"])
    assert os.access(ROOT / script, os.X_OK)
    assert f"\n  {goal})" in (ROOT / script).read_text("utf-8")
