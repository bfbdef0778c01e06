"""Run the rings of the tests, from the pure ones to the whole graph, and sum up what they said.

    python environment/run_tests.py [pytest options]

The rings of the library, of the drivers and of the nodes share out their tests between two
processes. Tests of nodes that are marked ``alone`` serve or judge pictures at the camera's rate,
and those of graphs run every node in real time, so they have the machine to themselves, one after
the other. Every ring runs, also after one that failed; the last line counts all.
"""

from __future__ import annotations

import re
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
# Name of the ring: the folder in test/ and the options with which it is run.
RINGS: dict[str, tuple[str, ...]] = {
    "pure": ("pure", "-n", "2"),
    "pty": ("pty", "-n", "2"),
    "nodes": ("nodes", "-m", "not alone", "-n", "2"),
    "nodes, alone": ("nodes", "-m", "alone"),
    "graph": ("graph",),
}
NO_TESTS_COLLECTED = 5  # pytest's exit status
# As pytest's closing line has them.
OUTCOMES = ("failed", "passed", "skipped", "deselected", "xfailed", "xpassed", "warnings", "errors")
COUNT = re.compile(rf"(\d+) ({'|'.join(OUTCOMES)}|warning|error)\b")


def counts_of(closing_line: str) -> Counter[str]:
    """The outcomes that a closing line of pytest counts: ``"2 passed, 1 error in 3.1s"``."""
    plural = {"warning": "warnings", "error": "errors"}
    return Counter(
        {plural.get(word, word): int(number) for number, word in COUNT.findall(closing_line)}
    )


def closing_line(counts: Counter[str], seconds: float) -> str:
    """One line in the form of pytest's own closing line."""
    said = [f"{counts[outcome]} {outcome}" for outcome in OUTCOMES if counts[outcome]]
    return f" {', '.join(said) or 'no tests ran'} in {seconds:.2f}s ".center(80, "=")


def run_ring(ring: str, options: Sequence[str]) -> tuple[int, Counter[str]]:
    """Run one ring; its exit status and its outcomes."""
    folder, *own = RINGS[ring]
    words = [sys.executable, "-m", "pytest", f"test/{folder}", *own, *options]
    last = ""
    with subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            print(line, end="", flush=True)
            last = line if line.strip() else last
    return process.returncode, counts_of(last)


def main(options: Sequence[str]) -> int:
    """Exit status 0 if every ring passed."""
    started = time.monotonic()
    total: Counter[str] = Counter()
    failed = []
    for ring in RINGS:
        folder = RINGS[ring][0]
        if not (ROOT / "test" / folder).is_dir():
            print(f"---- ring {ring}: there is no folder test/{folder}", flush=True)
            failed.append(ring)
            continue
        print(f"---- ring {ring}", flush=True)
        status, counts = run_ring(ring, options)
        total += counts
        # A choice of tests (-k, -m) may leave a ring without any; a whole ring may not be empty.
        if status != 0 and not (status == NO_TESTS_COLLECTED and options):
            failed.append(ring)
    if failed:
        print(f"---- failed: {', '.join(failed)}")
    elif not total["passed"]:
        print("---- failed: no test ran")
    print(closing_line(total, time.monotonic() - started), flush=True)
    return 1 if failed or not total["passed"] else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
