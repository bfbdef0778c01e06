"""The checks that take hours: random faults in simulated time, mutation, and many examples of each
property test. ``make campaign`` runs and records them.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
DEFAULT_COUNT = 20_000
"""Number of goals in simulated time."""
KEPT = 20  # last lines of the output of each check


def checks(goals: int) -> dict[str, list[str]]:
    """Return the command of each check, after ``python -m``."""
    return {
        "faults": ["lab", "faults", "--goals", str(goals), "--seed", "1"],
        "mutation": ["lab", "mutate"],
        "properties": ["pytest", "test/pure", "-q", "-n", "auto", "--timeout", "0"],
    }


def partial_reports(count: int) -> Iterator[list[dict[str, Any]]]:
    """Yield the results so far after each check; at the end, exit with an error if one failed."""
    results: list[dict[str, Any]] = []
    environment = {**os.environ, "HYPOTHESIS_PROFILE": "campaign"}
    for name, words in checks(count).items():
        began = time.monotonic()
        last: deque[str] = deque(maxlen=KEPT)
        command = [sys.executable, "-m", *words]
        with subprocess.Popen(
            command,
            cwd=ROOT,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        ) as process:
            assert process.stdout is not None
            for line in process.stdout:
                print(line, end="", flush=True)
                last.append(line.rstrip())
        results.append(
            {
                "check": name,
                "command": f"python -m {' '.join(words)}",
                "exit code": process.returncode,
                "hours": (time.monotonic() - began) / 3600,
                "output": list(last),
            }
        )
        yield results
    failed = [result["check"] for result in results if result["exit code"]]
    if failed:
        sys.exit(f"failed: {', '.join(failed)}")


def lines(report: list[dict[str, Any]]) -> list[str]:
    """Return the outcome of each check, and the end of its output."""
    text: list[str] = []
    for result in report:
        outcome = f"FAILED with exit code {result['exit code']}" if result["exit code"] else "passed"
        text.append(f"{result['check']}: {outcome} in {result['hours']:.2f} h, `{result['command']}`")
        text += [f"    {line}" for line in result["output"]]
    return text
