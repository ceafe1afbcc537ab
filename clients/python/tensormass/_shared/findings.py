"""Findings as text, and those that are about results. docs/findings.md lists their codes."""

from __future__ import annotations

from tensormass._shared.enums import short_name
from tensormass.v1 import finding_pb2, stream_pb2

_CODES = finding_pb2.FindingCode.DESCRIPTOR
#: Codes from here on are about the results of steps, others about the scene as it was loaded.
FIRST_OF_RESULTS = finding_pb2.FINDING_CODE_SOLVE_ABOVE_TOLERANCE


def code_of(finding: finding_pb2.Finding) -> str:
    """Returns the short name of a finding's code; its number if it is of a newer daemon."""
    if finding.code not in _CODES.values_by_number:
        return str(finding.code)
    return short_name(_CODES, finding.code)


def text_of(finding: finding_pb2.Finding) -> str:
    """Returns a finding on one line, as the daemon's warnings have it."""
    return f"{finding.message}; {finding.remedy}"


def key_of(finding: finding_pb2.Finding) -> tuple[int, str, str, str]:
    """Returns what tells findings apart, although their numbers change from step to step."""
    return finding.code, finding.body, finding.other, finding.tool


def of_results(status: stream_pb2.SceneStatus) -> list[finding_pb2.Finding]:
    """Returns the findings about the last steps that the scene does not accept."""
    return [one for one in status.findings if one.code >= FIRST_OF_RESULTS and not one.accepted]
