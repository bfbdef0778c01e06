"""Verbs that consist of sub-verbs: ``calibrate`` and ``object``."""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Mapping
from typing import Protocol, cast


class Verb(Protocol):
    """Interface of the module of a sub-verb, which is that of a verb's module."""

    __doc__: str | None

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Declare the options."""

    def run(self, arguments: argparse.Namespace) -> int:
        """Run the sub-verb. Return the exit code."""


def add_subverbs(parser: argparse.ArgumentParser, package: str, texts: Mapping[str, str]) -> None:
    """Declare sub-verbs: ``texts`` has the help of each, and ``package`` their modules
    ``*_verb``."""
    sub = parser.add_subparsers(dest="subject", required=True, metavar="WHAT")
    for name, text in texts.items():
        module = subverb(package, name)
        one = sub.add_parser(
            name,
            help=text,
            description=module.__doc__,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        module.add_arguments(one)


def subverb(package: str, name: str) -> Verb:
    """Return the module of a sub-verb."""
    return cast(Verb, importlib.import_module(f"tapping_cell.cli.{package}.{name}_verb"))
