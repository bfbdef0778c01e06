"""Print shell code with which the tabulator key completes verbs and options.

It also makes `cell` a short name of `python -m tapping_cell`. Put the line into ~/.bashrc, or call
it in a shell:

    eval "$(python -m tapping_cell completion)"
    eval "$(python -m tapping_cell completion --shell zsh)"

then `cell de<Tab>`, `cell demo --<Tab>`. Where the installed executable `cell` is on the path,
`eval "$(register-python-argcomplete cell)"` does the same for it.

    python -m tapping_cell completion --shell fish
"""

from __future__ import annotations

import argparse
import shlex
import sys

from argcomplete.shell_integration import shellcode

NAME = "cell"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of the verb."""
    parser.add_argument(
        "--shell", choices=("bash", "zsh", "fish"), default="bash", help="kind of shell"
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the verb; 0."""
    command = f"{shlex.quote(sys.executable)} -m tapping_cell"
    if arguments.shell == "fish":
        print(f"function {NAME}; {command} $argv; end")
    else:
        print(f'{NAME}() {{ {command} "$@"; }}')
    print(shellcode([NAME], shell=arguments.shell))
    return 0
