"""Write the reference pages of docs/ that are made from the code.

    python environment/reference_pages.py        (or: make reference)

Tests compare the pages with what this writes.
"""

from __future__ import annotations

import argparse
import inspect
from collections.abc import Callable, Iterator
from pathlib import Path

from tapping_cell.cli import VERBS, verb_parser
from tapping_cell.report import error_codes

DOCS = Path(__file__).resolve().parent.parent / "docs"
_HEAD = """# Commands

`python -m tapping_cell VERB`, or `ros2 run tapping_cell cell VERB`. Every verb has `--help` with an
example. Lengths are in mm and angles in degrees where people type them. Verbs with `--json` print
figures for a program on standard output and words on standard error; progress is shown on a
terminal only. Exit status: 0 done, 1 not reached or something found, 2 wrong input, 130
interrupted.

The tabulator key completes verbs and options after

    eval "$(python -m tapping_cell completion)"

in `~/.bashrc`, which also makes `cell` a short name: `cell goal 20 10 0`.

`make reference` writes this page.
"""
_ERROR_CODES = """# Error codes

Every refusal and failure of the cell has a number of `tapping_cell_msgs/msg/ErrorCode` and a
message with the value and the limit. The command line, the report of a run and the operator page
show the hint of the last column.

`msg_defs/msg/ErrorCode.msg` declares the codes; `make reference` writes this page from it.

| code | name | when | what to do |
| --- | --- | --- | --- |
"""


def commands_page() -> str:
    """Every verb and option, from the parsers."""
    parts = [_HEAD]
    for verb, text in VERBS.items():
        parser, _ = verb_parser(verb)
        parts.append(f"\n## `{verb}`\n\n{text[0].upper()}{text[1:]}.\n")
        parts += [f"\n    {line}\n" for line in examples(parser)[:1]]
        parts += _tables(parser)
    return "".join(parts)


def examples(parser: argparse.ArgumentParser) -> list[str]:
    """The command lines in a parser's description."""
    lines = inspect.cleandoc(parser.description or "").splitlines()
    return [line.strip() for line in lines if line.strip().startswith("python -m tapping_cell ")]


def _tables(parser: argparse.ArgumentParser) -> Iterator[str]:
    rows = []
    inner: list[tuple[str, argparse.ArgumentParser]] = []
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            inner += list(action.choices.items())
        elif not isinstance(action, argparse._HelpAction):
            rows.append(f"| {_name(action)} | {_default(action)} | {_text(action.help)} |\n")
    if rows:
        yield "\n| option | default | what |\n| --- | --- | --- |\n"
        yield from rows
    for name, own in inner:
        yield f"\n### `{parser.prog.split(' ', 1)[1]} {name}`\n"
        yield from _tables(own)


def _name(action: argparse.Action) -> str:
    names = ", ".join(f"`{name}`" for name in action.option_strings)
    metavar = action.metavar or ("" if action.nargs == 0 else action.dest.upper().replace("_", "-"))
    if action.choices is not None and action.metavar is None:
        metavar = ", ".join(str(choice) for choice in action.choices)
    values = " ".join(metavar) if isinstance(metavar, tuple) else metavar
    return f"{names} {values}".strip() if names else f"`{values}`"


def _default(action: argparse.Action) -> str:
    value = action.default
    if value in (None, False, "", [], argparse.SUPPRESS) or not action.option_strings:
        return ""
    return " ".join(map(str, value)) if isinstance(value, (tuple, list)) else str(value)


def _text(words: str | None) -> str:
    return (words or "").replace("%%", "%").replace("|", "\\|")


def error_codes_page() -> str:
    """Every error code with its meaning and hint."""
    rows = (
        f"| {number} | {code.name} | {code.meaning} | {code.hint} |\n"
        for number, code in error_codes.codes().items()
    )
    return _ERROR_CODES + "".join(rows)


PAGES: dict[Path, Callable[[], str]] = {
    DOCS / "commands.md": commands_page,
    DOCS / "error_codes.md": error_codes_page,
}


if __name__ == "__main__":
    for file, text in PAGES.items():
        file.write_text(text(), encoding="utf-8")
