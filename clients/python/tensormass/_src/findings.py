"""Findings of a scene as Python warnings. docs/findings.md lists their codes."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterable
from pathlib import Path

from tensormass._shared.enums import enum_number
from tensormass._shared.findings import code_of, text_of
from tensormass.v1 import finding_pb2

_PACKAGE = str(Path(__file__).resolve().parents[1])
_CODES = finding_pb2.FindingCode.DESCRIPTOR


class FindingWarning(UserWarning):
    """A finding of a scene: what is probably a mistake in it, or wrong with its results.

    `warnings.filterwarnings("error", category=tm.FindingWarning)` refuses such scenes.
    """

    def __init__(self, finding: finding_pb2.Finding) -> None:
        super().__init__(finding)
        #: The protobuf message `tensormass.v1.Finding`.
        self.finding = finding

    def __str__(self) -> str:
        return text_of(self.finding)

    @property
    def code(self) -> str:
        """Returns the kind of finding, such as "locking"."""
        return code_of(self.finding)

    @property
    def value(self) -> float:
        """Returns what was found, in `unit`."""
        return self.finding.value

    @property
    def limit(self) -> float:
        """Returns the threshold that `value` passed, in `unit`."""
        return self.finding.limit

    @property
    def unit(self) -> str:
        """Returns the unit of `value` and `limit`; empty for a ratio or a count."""
        return self.finding.unit

    @property
    def place(self) -> str:
        """Returns the field of the scene to look at, such as "body 'liver'.quadrature"."""
        return self.finding.place

    @property
    def body(self) -> str:
        """Returns the name of the body that it concerns; empty if there is none."""
        return self.finding.body

    @property
    def other(self) -> str:
        """Returns the name of the other body; empty if there is none."""
        return self.finding.other

    @property
    def tool(self) -> str:
        """Returns the name of the tool that it concerns; empty if there is none."""
        return self.finding.tool

    @property
    def message(self) -> str:
        """Returns what was found, in words."""
        return self.finding.message

    @property
    def remedy(self) -> str:
        """Returns what to do about it."""
        return self.finding.remedy


def code_number(code: str) -> finding_pb2.FindingCode:
    """Returns the number of a code by its short name. Raises InvalidArgumentError if there is none."""
    number: finding_pb2.FindingCode = enum_number(_CODES, code, "code")  # type: ignore[assignment]
    return number


def warn_of(findings: Iterable[finding_pb2.Finding]) -> None:
    """Issues a FindingWarning for each finding that the scene does not accept, at the caller of this package."""
    for finding in findings:
        if finding.accepted:
            continue
        warning = FindingWarning(finding)
        if sys.version_info >= (3, 12):
            warnings.warn(warning, skip_file_prefixes=(_PACKAGE,))
        else:
            warnings.warn(warning, stacklevel=3)
