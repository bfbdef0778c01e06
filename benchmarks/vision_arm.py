"""Wrong poses among ten thousand frames in which the arm crosses the object and the references."""

from __future__ import annotations

from typing import Any

from benchmarks.vision_robustness import ARM_CASES, lines_of_cases, measure_cases

DEFAULT_COUNT = 10_000


def measure(count: int) -> dict[str, Any]:
    """Let the arm reach over object and reference markers for at least ``count`` frames."""
    return measure_cases(ARM_CASES, count)


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    return lines_of_cases(report)
