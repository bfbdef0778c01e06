"""Write ``requirements.lock``: the exact version of everything, for every Python that is supported.

    python3 environment/lock.py python3.10 python3.11 python3.12 python3.13

Each interpreter's own pip resolves ``requirements.in``; a version that holds for all of them
becomes a plain line, one that does not gets an environment marker for each Python.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
HEADER = """\
# Exact versions of everything in .venv, made by `make lock` from environment/requirements.in.
# It is complete: it is installed without looking for what packages need.
"""


def resolve(interpreter: str) -> tuple[str, dict[str, str]]:
    """The interpreter's ``X.Y`` and the versions that its pip chooses, by normalised name."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([interpreter, "-m", "venv", folder], check=True)
        python = f"{folder}/bin/python"
        report = Path(folder, "report.json")
        pip = [python, "-m", "pip", "install", "--quiet", "--dry-run", "--report", str(report)]
        subprocess.run([*pip, "-r", str(HERE / "requirements.in")], check=True)
        entries = json.loads(report.read_text())
    version = ".".join(entries["environment"]["python_version"].split(".")[:2])
    chosen = {
        re.sub(r"[-_.]+", "-", entry["metadata"]["name"]).lower(): entry["metadata"]["version"]
        for entry in entries["install"]
    }
    return version, chosen


def merge(resolved: dict[str, dict[str, str]]) -> list[str]:
    """Requirement lines from ``{python version: {name: version}}``, in order of name."""
    lines = []
    for name in sorted(set().union(*resolved.values())):
        versions = {python: chosen.get(name) for python, chosen in resolved.items()}
        if len(set(versions.values())) == 1:
            lines.append(f"{name}=={next(iter(versions.values()))}")
            continue
        lines.extend(
            f'{name}=={version} ; python_version == "{python}"'
            for python, version in sorted(versions.items(), key=lambda item: int(item[0][2:]))
            if version is not None
        )
    return lines


def main(interpreters: list[str]) -> int:
    if not interpreters:
        print(__doc__, file=sys.stderr)
        return 2
    lines = merge(dict(resolve(interpreter) for interpreter in interpreters))
    (HERE.parent / "requirements.lock").write_text(HEADER + "\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
