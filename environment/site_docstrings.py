"""Convert the lists of fields and the commands in docstrings to lists and code blocks of the site.

In the source, a field is written as ``name: meaning``, and a command is indented by two spaces.
This notation is easy to read in the source and in a terminal, but it is not markup.
"""

from __future__ import annotations

import re

_FIELDS = re.compile(r"^((?:``)?\w+(?:``)?(?:, (?:``)?\w+(?:``)?)*): (\S.*)$")
_HEADINGS = {"Args", "Raises", "Returns", "Yields", "Attributes", "Note", "Example", "Examples"}


def lists_and_commands(
    app: object, what: str, name: str, obj: object, options: object, lines: list[str]
) -> None:
    """Change the lines of one docstring in place. Sphinx calls this for each docstring."""
    made: list[str] = []
    listed = block = False
    for line in lines:
        if "``" not in line:
            # here, a bar means an absolute value, not a substitution
            line = line.replace("|", "\\|")
        field = _FIELDS.match(line)
        before = made[-1] if made else ""
        if block and line.startswith("  "):
            made.append("    " + line)
            continue
        block = False
        if re.match(r" {2,4}(python|ros2|colcon|\.|make) ", line) and not before.strip():
            made += ["::", "", "    " + line]
            block = True
        elif field is not None and field[1] not in _HEADINGS and what != "function":
            if before.strip() and not listed:
                made.append("")
            made.append(f"* **{field[1].replace('`', '')}**: {field[2]}")
            listed = True
        elif listed and line.startswith("    "):
            made.append("  " + line.lstrip())
        else:
            if listed and line.strip():
                made.append("")
            listed = False
            made.append(line)
    lines[:] = made
