"""Run the laboratory from the root of the source tree: ``python -m lab VERB``."""

from __future__ import annotations

import argparse
import importlib
import sys

VERBS = {"mutate": ("lab.mutation", "test the tests: change the code and count what they find")}


def main() -> int:
    """Run a verb; return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m lab", description=__doc__)
    verbs = parser.add_subparsers(dest="verb", required=True)
    for name, (module, words) in VERBS.items():
        importlib.import_module(module).add_arguments(
            verbs.add_parser(name, help=words, description=words)
        )
    arguments = parser.parse_args()
    module, _ = VERBS[arguments.verb]
    return int(importlib.import_module(module).run(arguments))


if __name__ == "__main__":
    sys.exit(main())
