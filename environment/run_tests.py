"""Run the groups of tests ("rings"), from the pure ones to the complete graph, and add up their
results.

    python environment/run_tests.py [pytest options]

The pure ring is limited by the processor and does not depend on time. The pure ring runs at low
priority in parallel with the other rings. The rings of the drivers and of the nodes mostly wait, so
each of these two rings distributes its tests to several processes. Tests of nodes that are marked
``alone`` publish or process images at the camera's frame rate, and the graph tests run all nodes in
real time. These tests run one after the other. The graph tests run after the pure ring has ended.
Every ring runs even if an earlier ring failed. At the end, the duration and the processor time of
each ring are printed. The last line contains the counts of all rings.
"""

from __future__ import annotations

import os
import re
import resource
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
# Name of the ring (the name of its folder in test/), and the options with which the ring is run.
RINGS: dict[str, tuple[str, ...]] = {
    "pure": ("pure", "-n", "2"),
    "pty": ("pty", "-n", "4"),
    "nodes": ("nodes", "-m", "not alone", "-n", "3"),
    "nodes, alone": ("nodes", "-m", "alone"),
    "graph": ("graph",),
}
BESIDE = "pure"  # runs in parallel with the other rings
ALONE = "graph"  # whole graphs in real time: nothing else runs at the same time
LOW_PRIORITY = 15  # niceness of the ring that runs in parallel with the others
NO_TESTS_COLLECTED = 5  # pytest's exit code
# The words in pytest's closing line.
OUTCOMES = ("failed", "passed", "skipped", "deselected", "xfailed", "xpassed", "warnings", "errors")
COUNT = re.compile(rf"(\d+) ({'|'.join(OUTCOMES)}|warning|error)\b")


def counts_of(closing_line: str) -> Counter[str]:
    """Return the counts in pytest's closing line, such as ``2 passed, 1 error in 3.1s``."""
    plural = {"warning": "warnings", "error": "errors"}
    return Counter(
        {plural.get(word, word): int(number) for number, word in COUNT.findall(closing_line)}
    )


def closing_line(counts: Counter[str], seconds: float) -> str:
    """Return a line in the format of pytest's closing line."""
    counted = [f"{counts[outcome]} {outcome}" for outcome in OUTCOMES if counts[outcome]]
    return f" {', '.join(counted) or 'no tests ran'} in {seconds:.2f}s ".center(80, "=")


def started(ring: str, options: Sequence[str], output: int | IO[str]) -> subprocess.Popen[str]:
    """Start the tests of a ring and return the process."""
    folder, *own = RINGS[ring]
    command = [sys.executable, "-m", "pytest", f"test/{folder}", *own, *options]
    if ring == BESIDE:
        command = ["nice", "-n", str(LOW_PRIORITY), *command]
    return subprocess.Popen(command, cwd=ROOT, stdout=output, text=True)


def ended(ring: str, process: subprocess.Popen[str], began: float) -> str:
    """Wait for the tests of a ring, and return a line with their duration and processor time, in
    s."""
    before = processor_time()
    process.wait()
    used = processor_time() - before
    return f"{ring:<14} {time.monotonic() - began:6.0f} s, processor time {used:6.0f} s"


def processor_time() -> float:
    """Return the processor time in s of all child processes that have been waited for."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def count_outcomes(ring: str, lines: Iterable[str]) -> Counter[str]:
    """Print the output of a ring and return its counts."""
    print(f"---- ring {ring}", flush=True)
    last = ""
    for line in lines:
        print(line, end="", flush=True)
        last = line if line.strip() else last
    return counts_of(last)


def run_rings(options: Sequence[str]) -> tuple[list[str], Counter[str]]:
    """Run every ring, and print its duration. Return the names of the failed rings and the counts
    of all rings."""
    total: Counter[str] = Counter()
    failed: list[str] = []
    durations: list[str] = []
    began = time.monotonic()

    def judge(ring: str, status: int) -> None:
        # A selection (-k, -m) may leave a ring without tests. Without a selection, each ring must
        # have tests.
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
            stack.callback(beside.terminate)  # has no effect if the process has ended
        for ring in there:
            if ring == BESIDE:
                continue
            if ring == ALONE and beside is not None:
                durations.append(ended(BESIDE, beside, began))
            ring_began = time.monotonic()
            with started(ring, options, subprocess.PIPE) as process:
                assert process.stdout is not None
                total += count_outcomes(ring, process.stdout)
                durations.append(ended(ring, process, ring_began))
            judge(ring, process.returncode)
        if beside is not None:
            if beside.returncode is None:
                durations.append(ended(BESIDE, beside, began))
            judge(BESIDE, beside.returncode)
            log.seek(0)
            total += count_outcomes(BESIDE, log)
    print("---- durations", *durations, sep="\n", flush=True)
    return failed, total


def main(options: Sequence[str]) -> int:
    """Run all rings. Return the exit code: 0 if every ring passed."""
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="tapping_cell-") as cache:
        # The rings share results that take long to compute, such as a planner's policy.
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
