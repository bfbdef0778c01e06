"""Print shell code for completing verbs and options with the Tab key.

The code also makes `cell` a short name of `python -m tapping_cell`. Add one of these lines to the
start-up file of your shell, such as ~/.bashrc, or run it in a shell:

    eval "$(python -m tapping_cell completion)"
    eval "$(python -m tapping_cell completion --shell zsh)"

Then type `cell de<Tab>` or `cell demo --<Tab>`. If the installed executable `cell` is on the path,
`eval "$(register-python-argcomplete cell)"` enables the completion of that executable.

    python -m tapping_cell completion --shell fish
"""

from __future__ import annotations

import argparse
import shlex
import sys

from argcomplete.shell_integration import shellcode

NAME = "cell"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument(
        "--shell",
        choices=("bash", "zsh", "fish"),
        default="bash",
        help="shell to print the code for (default: bash)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the verb. Return 0."""
    command = f"{shlex.quote(sys.executable)} -m tapping_cell"
    if arguments.shell == "fish":
        print(f"function {NAME}; {command} $argv; end")
    else:
        print(f'{NAME}() {{ {command} "$@"; }}')
    print(shellcode([NAME], shell=arguments.shell))
    return 0
