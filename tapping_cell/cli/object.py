"""Create object files from images, and fit them to taps.

python -m tapping_cell object new shot.png --name bracket --height 12 --output bracket.yaml
python -m tapping_cell object learn --object bracket.yaml --output bracket_learnt.yaml
python -m tapping_cell object fit records/ --output config/objects/my_disk.yaml
"""

from __future__ import annotations

import argparse
import importlib
from types import ModuleType

SUBVERBS = {
    "new": "create an object file from an image of the object",
    "learn": "learn friction and torque factor of an object from taps",
    "fit": "fit friction and impact of an object to records of single taps",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the sub-verbs."""
    sub = parser.add_subparsers(dest="subject", required=True, metavar="WHAT")
    for name, text in SUBVERBS.items():
        module = _module(name)
        one = sub.add_parser(
            name,
            help=text,
            description=module.__doc__,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        module.add_arguments(one)


def run(arguments: argparse.Namespace) -> int:
    """Run a sub-verb. Return its exit code."""
    return int(_module(arguments.subject).run(arguments))


def _module(name: str) -> ModuleType:
    return importlib.import_module(f"tapping_cell.cli.objects.{name}_verb")
