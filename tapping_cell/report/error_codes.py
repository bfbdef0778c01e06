"""The error codes with symptom, cause and remedy, from ``ErrorCode.msg``, which declares them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache

from tapping_cell.report.message_files import definition_file

_DECLARATION = re.compile(
    r"^uint16 (?P<name>\w+) = (?P<number>\d+) +# (?P<symptom>[^|]+?)"
    r"(?: \| (?P<cause>[^|]+) \| (?P<remedy>.+))?$",
    re.MULTILINE,
)


@dataclass(frozen=True, slots=True)
class Code:
    """One error code with its name, symptom, usual cause and remedy."""

    name: str
    symptom: str
    cause: str
    remedy: str


@cache
def codes() -> dict[int, Code]:
    """Return all error codes by number."""
    text = definition_file("tapping_cell_msgs/msg/ErrorCode").read_text(encoding="utf-8")
    return {
        int(found["number"]): Code(
            found["name"], found["symptom"], found["cause"] or "", found["remedy"] or ""
        )
        for found in _DECLARATION.finditer(text)
    }


def name(number: int) -> str:
    """Return the name of a code. For an unknown code, for example of a later version, return its
    number as text."""
    found = codes().get(number)
    return found.name if found else str(number)


def hint(number: int) -> str:
    """Return the remedy for a code; empty if there is none or the code is unknown."""
    found = codes().get(number)
    return found.remedy if found else ""


def number(name: str) -> int:
    """Return the number of a declared code.

    Raises:
        KeyError: no code has this name.
    """
    return {code.name: number for number, code in codes().items()}[name]
