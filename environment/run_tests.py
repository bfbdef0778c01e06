"""Run the groups of tests ("rings"), from the pure ones to the complete graph, and add up their
results.

    python environment/run_tests.py [pytest options]

The pure ring is limited by the processor and does not depend on time, so it runs beside the others,
with what they leave of the processor. The other rings run in real time, one after the other: those
of the drivers and of the nodes mostly wait and distribute their tests to several processes; the
graph tests run all nodes. Every ring runs even if an earlier ring failed. A test that runs in real
time may fail because another program kept the processor from it, so the failed ones are repeated
once, when nothing else runs; one that then passes is printed as repeated. At the end, the processor
time of each ring and the ten slowest tests are printed. The last line contains the counts of all
rings.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
# Name of the ring (the name of its folder in test/), and the options with which the ring is run.
RINGS: dict[str, tuple[str, ...]] = {
    "pure": ("pure", "-n", "2"),
    "pty": ("pty", "-n", "3"),
    "nodes": ("nodes", "-n", "3", "--dist", "loadfile"),
    "graph": ("graph",),
}
# The ring that runs beside the others.
BESIDE = "pure"
SLOWEST = 10
# Exit codes of pytest.
TESTS_FAILED, NO_TESTS_COLLECTED = 1, 5
# The words in pytest's closing line.
OUTCOMES = ("failed", "passed", "skipped", "deselected", "xfailed", "xpassed", "warnings", "errors")
COUNT = re.compile(rf"(\d+) ({'|'.join(OUTCOMES)}|warning|error)\b")
DURATION = re.compile(r"([\d.]+)s (?:call|setup|teardown) +\S+")


def counts_of(closing_line: str) -> Counter[str]:
    """Return the counts in pytest's closing line, such as ``2 passed, 1 error in 3.1s``."""
    plural = {"warning": "warnings", "error": "errors"}
    return Counter(
        {plural.get(word, word): int(number) for number, word in COUNT.findall(closing_line)}
    )


def closing_line(counts: Counter[str], seconds: float) -> str:
    """Return a line in the format of pytest's closing line."""
    printed = (*OUTCOMES, "repeated")
    counted = [f"{counts[outcome]} {outcome}" for outcome in printed if counts[outcome]]
    return f" {', '.join(counted) or 'no tests ran'} in {seconds:.2f}s ".center(80, "=")


def started(ring: str, options: Sequence[str]) -> subprocess.Popen[str]:
    """Start the tests of a ring and return the process."""
    folder, *own = RINGS[ring]
    own += [f"--durations={SLOWEST}", "-o", f"cache_dir={os.environ['XDG_CACHE_HOME']}/{ring}"]
    command = [sys.executable, "-m", "pytest", f"test/{folder}", *own, *options]
    before = give_way if ring == BESIDE else None
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, preexec_fn=before)


def give_way() -> None:
    """Let the processes of all other rings run first. Linux compares the niceness within a session,
    and that of the session's group with the groups of other sessions."""
    os.setsid()
    os.nice(19)
    with contextlib.suppress(OSError):
        Path("/proc/self/autogroup").write_text("19", encoding="ascii")


def ended(process: subprocess.Popen[str]) -> float:
    """Wait for a process. Return the processor time of it and of its children, in s."""
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    return usage.ru_utime + usage.ru_stime


def count_outcomes(ring: str, lines: Iterable[str], slow: list[str]) -> Counter[str]:
    """Print the output of a ring and return its counts. The lines with the durations of its slowest
    tests are added to ``slow``."""
    print(f"---- ring {ring}", flush=True)
    last = ""
    for line in lines:
        if DURATION.match(line):
            slow.append(line.rstrip())
            continue
        print(line, end="", flush=True)
        last = line if line.strip() else last
    return counts_of(last)


def repeat_failed(ring: str, options: Sequence[str], slow: list[str]) -> Counter[str]:
    """Run the failed tests of a ring once more, one at a time, and return how many passed and
    failed."""
    again = ("-n", "0", "--last-failed", "--last-failed-no-failures=none")
    process = started(ring, [*options, *again])
    assert process.stdout is not None
    counts = count_outcomes(f"{ring}, failed tests repeated", process.stdout, slow)
    if ended(process) and process.returncode not in (0, TESTS_FAILED):
        counts["errors"] += 1
    return Counter({name: counts[name] for name in ("passed", "failed", "errors")})


def run_rings(options: Sequence[str]) -> tuple[list[str], Counter[str]]:
    """Run every ring, and print its duration. Return the names of the failed rings and the counts
    of all rings."""
    total: Counter[str] = Counter()
    failed: list[str] = []
    disturbed: dict[str, Counter[str]] = {}
    durations: list[str] = []
    slow: list[str] = []
    beside: list[str] = []
    began = {BESIDE: time.monotonic()}
    first = started(BESIDE, options)
    try:
        assert first.stdout is not None
        reader = threading.Thread(target=beside.extend, args=(first.stdout,))
        reader.start()
        for ring in (*(ring for ring in RINGS if ring != BESIDE), BESIDE):
            if not (ROOT / "test" / RINGS[ring][0]).is_dir():
                print(f"---- ring {ring}: there is no folder test/{RINGS[ring][0]}", flush=True)
                failed.append(ring)
                continue
            if ring == BESIDE:
                reader.join()
                process, lines = first, iter(beside)
            else:
                began[ring] = time.monotonic()
                process = started(ring, options)
                assert process.stdout is not None
                lines = process.stdout
            counts = count_outcomes(ring, lines, slow)
            total += counts
            used = ended(process)
            # A selection (-k, -m) may leave a ring without tests. Without a selection, each ring
            # must have tests.
            if process.returncode and not (process.returncode == NO_TESTS_COLLECTED and options):
                failed.append(ring)
            if process.returncode == TESTS_FAILED and ring != BESIDE:
                disturbed[ring] = counts
            took = time.monotonic() - began[ring]
            durations.append(f"{ring:<14} {took:6.0f} s, processor time {used:6.0f} s")
    finally:
        if first.returncode is None:
            os.killpg(first.pid, signal.SIGKILL)
    for ring, before in disturbed.items():
        again = repeat_failed(ring, options, slow)
        total["repeated"] += again["passed"]
        total += again
        for outcome in ("failed", "errors"):
            total[outcome] -= before[outcome]
        if not again["failed"] + again["errors"]:
            failed.remove(ring)
    slow.sort(key=lambda line: -float(line.split("s ")[0]))
    print("---- slowest tests", *slow[:SLOWEST], sep="\n", flush=True)
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
