"""Run the rings of the tests, from the pure ones to the whole graph, and sum up what they said.

    python environment/run_tests.py [pytest options]

The pure ring needs the processor and no clock: it runs beside the others at low priority, and takes
what they leave. The rings of the drivers and of the nodes mostly wait, and share out their tests
between several processes. Tests of nodes that are marked ``alone`` serve or judge pictures at the
camera's rate, and those of graphs run every node in real time: one after the other, the graphs when
the pure ring has ended. Every ring runs, also after one that failed; the last line counts all.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import IO

ROOT = Path(__file__).resolve().parent.parent
# Name of the ring: the folder in test/ and the options with which it is run.
RINGS: dict[str, tuple[str, ...]] = {
    "pure": ("pure", "-n", "2"),
    "pty": ("pty", "-n", "4"),
    "nodes": ("nodes", "-m", "not alone", "-n", "3"),
    "nodes, alone": ("nodes", "-m", "alone"),
    "graph": ("graph",),
}
BESIDE = "pure"
ALONE = "graph"  # whole graphs in real time: nothing runs beside them
LOW_PRIORITY = 15  # niceness of the ring that runs beside the others
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
    counted = [f"{counts[outcome]} {outcome}" for outcome in OUTCOMES if counts[outcome]]
    return f" {', '.join(counted) or 'no tests ran'} in {seconds:.2f}s ".center(80, "=")


def started(ring: str, options: Sequence[str], output: int | IO[str]) -> subprocess.Popen[str]:
    """The process of a ring."""
    folder, *own = RINGS[ring]
    words = [sys.executable, "-m", "pytest", f"test/{folder}", *own, *options]
    if ring == BESIDE:
        words = ["nice", "-n", str(LOW_PRIORITY), *words]
    return subprocess.Popen(words, cwd=ROOT, stdout=output, text=True)


def count_outcomes(ring: str, lines: Iterable[str]) -> Counter[str]:
    """Print what a ring says; its outcomes."""
    print(f"---- ring {ring}", flush=True)
    last = ""
    for line in lines:
        print(line, end="", flush=True)
        last = line if line.strip() else last
    return counts_of(last)


def run_rings(options: Sequence[str]) -> tuple[list[str], Counter[str]]:
    """Run every ring; those that failed, and the outcomes of all."""
    total: Counter[str] = Counter()
    failed: list[str] = []

    def judge(ring: str, status: int) -> None:
        # A choice of tests (-k, -m) may leave a ring without any; a whole ring may not be empty.
        if status != 0 and not (status == NO_TESTS_COLLECTED and options):
            failed.append(ring)

    there = [ring for ring in RINGS if (ROOT / "test" / RINGS[ring][0]).is_dir()]
    for ring in RINGS.keys() - there:
        print(f"---- ring {ring}: there is no folder test/{RINGS[ring][0]}", flush=True)
        failed.append(ring)
    with ExitStack() as stack:
        beside: subprocess.Popen[str] | None = None
        if BESIDE in there:
            log = stack.enter_context(tempfile.TemporaryFile("w+"))
            beside = stack.enter_context(started(BESIDE, options, log))
            stack.callback(beside.terminate)  # does nothing where it has ended
        for ring in there:
            if ring == BESIDE:
                continue
            if ring == ALONE and beside is not None:
                beside.wait()
            with started(ring, options, subprocess.PIPE) as process:
                assert process.stdout is not None
                total += count_outcomes(ring, process.stdout)
            judge(ring, process.returncode)
        if beside is not None:
            judge(BESIDE, beside.wait())
            log.seek(0)
            total += count_outcomes(BESIDE, log)
    return failed, total


def main(options: Sequence[str]) -> int:
    """Exit status 0 if every ring passed."""
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="tapping_cell-") as cache:
        # What one process solves for long (a planner's policy) serves every ring of this run.
        os.environ["XDG_CACHE_HOME"] = cache
        failed, total = run_rings(options)
    if failed:
        print(f"---- failed: {', '.join(failed)}")
    elif not total["passed"]:
        print("---- failed: no test ran")
    print(closing_line(total, time.monotonic() - began), flush=True)
    return 1 if failed or not total["passed"] else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
