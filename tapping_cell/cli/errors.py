"""Common error output of all verbs: one format, on stderr, and one set of exit codes.

error: what is wrong, the value and the limit; the remedy (error code)
"""

from __future__ import annotations

import argparse
import difflib
import re
from collections.abc import Iterable, Sequence
from enum import IntEnum
from typing import Any, NoReturn

from rich.console import Console
from rich.text import Text

from tapping_cell.cli.argument_types import finite, whole_number
from tapping_cell.messages import ErrorCode
from tapping_cell.report.error_codes import hint


class ExitStatus(IntEnum):
    """Exit codes of a verb; docs/commands.md contains the table."""

    DONE = 0
    FAILED = 1
    REFUSED = 2
    INTERRUPTED = 130
    READER_HAS_GONE = 141


MEANINGS = {
    ExitStatus.DONE: "success",
    ExitStatus.FAILED: "failure: the command could not be completed (the error states why), or the "
    "condition that it checks is false",
    ExitStatus.REFUSED: "refused: arguments or files are wrong, and nothing was started",
    ExitStatus.INTERRUPTED: "orderly end after Ctrl-C or a termination signal",
    ExitStatus.READER_HAS_GONE: "the reader of the output has closed it, as `head` does",
}
"""Description of each exit code."""


def print_error(sentence: str, code: int = 0) -> None:
    """Print an error and, if the code has a remedy, this remedy."""
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    number = f" ({code})" if code and not sentence.endswith(f"({code})") else ""
    console.print(Text.assemble(("error: ", "red"), f"{sentence}{number}"))
    if code and (advice := hint(code)):
        console.print(Text(f"what to do: {advice}"))


def print_refusal(error: Exception) -> int:
    """Print the reason why an input is rejected. Return the exit code."""
    from tapping_cell.planning import UnknownPlannerError

    unknown = isinstance(error, UnknownPlannerError)
    print_error(str(error), ErrorCode.PLANNER_UNKNOWN if unknown else 0)
    return ExitStatus.REFUSED


def suggestion(word: str, known: Iterable[str]) -> str:
    """Return the known word that is closest to a misspelt word, as part of a sentence; empty if no
    known word is close."""
    # All options begin with the same dashes. The dashes would make any two options look similar.
    bare = {name.lstrip("-"): name for name in known}
    near = difflib.get_close_matches(word.lstrip("-"), bare, 1, 0.6)
    return f"; did you mean '{bare[near[0]]}'?" if near else ""


def unknown_option(words: str, option: str, known: Iterable[str]) -> str:
    """Return the error message for ``words`` on the command line that begin with an unknown
    option."""
    return f"there is no argument {words}{suggestion(option, known)}"


def wrong_choice(name: str, value: str, choices: Sequence[str]) -> str:
    """Return the error message for an argument whose value is none of its choices."""
    near = suggestion(value, choices)
    return f"{name} cannot be '{value}': choose from {', '.join(choices)}{near}"


class Parser(argparse.ArgumentParser):
    """Argument parser whose error messages have the format of all other errors of the verbs.

    Numbers must be finite.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        # An abbreviation can become ambiguous, or mean something else, when an option is added.
        super().__init__(*arguments, **{"allow_abbrev": False, **options})
        # Use these functions instead of Python's float and int, because float accepts "nan" and
        # "inf".
        self.register("type", float, finite)
        self.register("type", int, whole_number)

    def error(self, message: str) -> NoReturn:
        """Reject an invalid command line."""
        print_error(f"{self._sentence(message)} ({self.prog} --help shows the options)")
        self.exit(ExitStatus.REFUSED)

    def _sentence(self, message: str) -> str:
        unknown = re.fullmatch(r"unrecognized arguments: (.*)", message)
        if unknown:
            first = unknown[1].split()[0]
            options = [name for action in self._actions for name in action.option_strings]
            return unknown_option(unknown[1], first.split("=")[0], options)
        wrong = re.fullmatch(
            r"argument (.+): invalid choice: '?(.*?)'? \(choose from (.*)\)", message
        )
        if wrong:
            return wrong_choice(wrong[1], wrong[2], wrong[3].replace("'", "").split(", "))
        return re.sub(r"^argument ([^:]+): ", r"\1: ", message)
