"""Wrong poses among ten thousand frames in which the arm moves over the object and the
references."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from benchmarks.vision_robustness import ARM_CASES, lines_of_cases, reports_of_cases

DEFAULT_COUNT = 10_000


def partial_reports(count: int) -> Iterator[dict[str, Any]]:
    """Run trials in which the arm reaches over object and reference markers, for at least ``count``
    frames, and yield the report so far after each camera."""
    yield from reports_of_cases(ARM_CASES, count)


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    return lines_of_cases(report)
