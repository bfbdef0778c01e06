"""Commands of the laboratory: ``python -m lab COMMAND``; ``COMMAND --help`` shows the options."""

from __future__ import annotations

import argparse
import importlib
import sys

from tapping_cell.cli.signals import end_on_signals

COMMANDS = {
    "faults": "lab.commands.faults",
    "drivers": "lab.commands.drivers",
    "mutate": "lab.mutation",
}
"""Module of each command, with its functions ``add_arguments`` and ``run``."""


def main() -> int:
    """Run one command. Return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m lab", allow_abbrev=False)
    parser.add_argument("command", choices=COMMANDS)
    name = parser.parse_args(sys.argv[1:2]).command
    module = importlib.import_module(COMMANDS[name])
    own = argparse.ArgumentParser(
        prog=f"python -m lab {name}",
        description=module.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    module.add_arguments(own)
    end_on_signals()
    try:
        return int(module.run(own.parse_args(sys.argv[2:])))
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
