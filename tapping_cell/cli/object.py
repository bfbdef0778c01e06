"""Create object files from images, and fit them to taps.

python -m tapping_cell object new shot.png --name bracket --height 12 --output bracket.yaml
python -m tapping_cell object learn --object bracket.yaml --output bracket_learnt.yaml
python -m tapping_cell object fit records/ --output config/objects/my_disk.yaml
"""

from __future__ import annotations

import argparse

from tapping_cell.cli.subverbs import add_subverbs, subverb

SUBVERBS = {
    "new": "create an object file from an image of the object",
    "learn": "learn friction and torque factor of an object from taps",
    "fit": "fit friction and impact of an object to records of single taps",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the sub-verbs."""
    add_subverbs(parser, "objects", SUBVERBS)


def run(arguments: argparse.Namespace) -> int:
    """Run a sub-verb. Return its exit code."""
    return subverb("objects", arguments.subject).run(arguments)
