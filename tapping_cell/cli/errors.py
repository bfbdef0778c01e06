"""How every verb says that something is wrong: one form, on the error output, and one exit status.

error: what is wrong, the value and the limit; what to do about it (number of the code)
"""

from __future__ import annotations

import argparse
import difflib
import re
from collections.abc import Iterable
from enum import IntEnum
from typing import Any, NoReturn

from rich.console import Console
from rich.text import Text

from tapping_cell.cli.argument_types import finite, whole_number
from tapping_cell.messages import ErrorCode
from tapping_cell.report.error_codes import hint


class ExitStatus(IntEnum):
    """What a verb's exit status means; docs/commands.md has the table."""

    DONE = 0
    FAILED = 1
    REFUSED = 2
    INTERRUPTED = 130
    READER_HAS_GONE = 141


MEANINGS = {
    ExitStatus.DONE: "done: what was asked for is true",
    ExitStatus.FAILED: "not done: it was tried and the error says why it failed, or what was "
    "asked for is not the case",
    ExitStatus.REFUSED: "refused: arguments or files are wrong, and nothing was started",
    ExitStatus.INTERRUPTED: "interrupted by Ctrl-C or a termination signal, in order",
    ExitStatus.READER_HAS_GONE: "the reader of the output has gone, as `head` does",
}
"""Each status in words."""


def tell_error(sentence: str, code: int = 0) -> None:
    """Print an error, and the remedy of its code where it has one."""
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    number = f" ({code})" if code and not sentence.endswith(f"({code})") else ""
    console.print(Text.assemble(("error: ", "red"), f"{sentence}{number}"))
    if code and (advice := hint(code)):
        console.print(Text(f"what to do: {advice}"))


def tell_refusal(error: Exception) -> int:
    """Print why an input is refused; returns the status."""
    from tapping_cell.planning import UnknownPlannerError

    unknown = isinstance(error, UnknownPlannerError)
    tell_error(str(error), ErrorCode.PLANNER_UNKNOWN if unknown else 0)
    return ExitStatus.REFUSED


def suggestion(word: str, known: Iterable[str]) -> str:
    """Which known word was probably meant, as a part of a sentence; empty where none is near."""
    near = difflib.get_close_matches(word, list(known), 1, 0.6)
    return f"; did you mean '{near[0]}'?" if near else ""


class Parser(argparse.ArgumentParser):
    """A parser whose refusals are one sentence in the form of every other error.

    Numbers must be finite.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        # In place of Python's own float, which takes "nan" and "inf".
        self.register("type", float, finite)
        self.register("type", int, whole_number)

    def error(self, message: str) -> NoReturn:
        """Refuse a wrong command line."""
        tell_error(f"{self._sentence(message)} ({self.prog} --help shows the options)")
        self.exit(ExitStatus.REFUSED)

    def _sentence(self, message: str) -> str:
        unknown = re.fullmatch(r"unrecognized arguments: (.*)", message)
        if unknown:
            first = unknown[1].split()[0]
            options = [name for action in self._actions for name in action.option_strings]
            return f"there is no argument {unknown[1]}{suggestion(first.split('=')[0], options)}"
        wrong = re.fullmatch(
            r"argument (.+): invalid choice: '?(.*?)'? \(choose from (.*)\)", message
        )
        if wrong:
            choices = wrong[3].replace("'", "").split(", ")
            near = suggestion(wrong[2], choices)
            return f"{wrong[1]} cannot be '{wrong[2]}': choose from {', '.join(choices)}{near}"
        return re.sub(r"^argument ([^:]+): ", r"\1: ", message)
