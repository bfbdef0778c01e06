"""Goals in a cell of three computers whose clocks differ, over a link with delay and packet loss.

The computers are network namespaces of this machine (``benchmarks.networks``). Camera and vision
run on one computer, the drivers on the second, and planner and recorder on the third.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from benchmarks.networks import Computer, computers, why_not
from tapping_cell.cli.graph import own_domain
from tapping_cell.nodes import MODULES

DEFAULT_COUNT = 10
"""Number of goals."""
DELAY_S, LOSS = 0.020, 0.01
PLACES = {
    "vision": ("sim_world", "camera_pose"),
    "drivers": ("scara_arm", "tapper_trigger"),
    "desk": ("tap_planner", "run_recorder"),
}
CLOCKS_S = {"vision": 0.3, "drivers": 0.1, "desk": 0.0}
"""Offset of each computer's clock in the run in which the cell must accept goals, in s."""
REFUSED_S = {
    "vision": {"vision": 2.0, "drivers": 0.0, "desk": 0.0},
    "drivers": {"vision": 0.0, "drivers": 2.0, "desk": 0.0},
}
"""Offsets of the computers' clocks, in s. The name of each entry is the computer whose clock is too
far ahead. A goal must be refused before its first tap, and the refusal must name this computer."""
TIMEOUT_S = 120.0


def measure(count: int) -> dict[str, Any]:
    """Return the results of the goals, and of those that must be refused."""
    reason = why_not()
    if reason:
        raise OSError(f"this section needs network namespaces: {reason}")
    own = {"ROS_DOMAIN_ID": str(own_domain().number)}
    report: dict[str, Any] = {"load": os.getloadavg()[0]}
    with tempfile.TemporaryDirectory() as folder, cell(Path(folder), own) as desk:
        report["goals"] = goals(desk, own, count)
    report["refused"] = {}
    for name, clocks in REFUSED_S.items():
        with tempfile.TemporaryDirectory() as folder, cell(Path(folder), own, clocks) as desk:
            (report["refused"][name],) = goals(desk, own, 1)
    return report


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    ends = report["goals"]
    reached = [end for end in ends if end["error_code"] == 0]
    made = [
        f"goals over {1000 * DELAY_S:.0f} ms and {100 * LOSS:.0f} % loss, clocks "
        f"{max(CLOCKS_S.values()):.1f} s apart: {len(reached)} of {len(ends)} reached"
    ]
    for end in ends:
        made.append(
            f"  {end['taps']} taps, {end['seconds']:.0f} s, truly {end['true_mm']:.2f} mm off "
            f"{end['error_msg']}"
        )
    made += [
        f"goal with the clock of '{name}' {REFUSED_S[name][name]:.1f} s ahead: {end['taps']} taps, "
        f"code {end['error_code']}: {end['error_msg']}"
        for name, end in report["refused"].items()
    ]
    return made


@contextlib.contextmanager
def cell(
    folder: Path, own: Mapping[str, str], clocks: Mapping[str, float] | None = None
) -> Iterator[Computer]:
    """Run the simulated cell on three computers and yield the operator's computer.

    ``clocks``: offset of each computer's clock in s, positive if the clock is ahead.
    """
    environment = {**own, "HOME": str(folder), "OPENBLAS_NUM_THREADS": "1"}
    shifts = CLOCKS_S if clocks is None else clocks
    started = []
    with computers(tuple(PLACES), DELAY_S, LOSS) as made, contextlib.ExitStack() as stack:
        try:
            for computer in made:
                for name in PLACES[computer.name]:
                    words = [sys.executable, "-m", "benchmarks.shifted_clock"]
                    words += [str(shifts[computer.name]), MODULES[name], "--ros-args"]
                    if name == "scara_arm":
                        words += ["-p", "home_on_activate:=true"]
                    if name == "run_recorder":
                        words += ["-p", f"folder:={folder / 'runs'}", "-p", "pictures:=false"]
                    log = stack.enter_context((folder / f"{name}.log").open("w"))
                    started.append(
                        computer.start(words, environment, stdout=log, stderr=subprocess.STDOUT)
                    )
            yield made[-1]
        finally:
            for process in started:
                process.terminate()
            for process in started:
                try:
                    process.wait(5.0)
                except subprocess.TimeoutExpired:
                    process.kill()


def goals(desk: Computer, own: Mapping[str, str], count: int) -> list[dict[str, Any]]:
    """Send goals one after the other from ``desk`` and return the true result of each goal."""
    words = [sys.executable, "-m", "benchmarks.two_computers", str(count)]
    client = desk.start(words, own, stdout=subprocess.PIPE)
    try:
        output, _ = client.communicate(timeout=TIMEOUT_S * (count + 1))
    finally:
        client.kill()
        client.wait()
    return [json.loads(line) for line in output.splitlines()]


# The following code runs on the desk computer.


def _send_goals(count: int) -> None:
    import random

    from tapping_cell.nodes.clients.goal_client import Finished, GoalClient
    from tapping_cell.se2 import Pose

    chance = random.Random(5)
    with GoalClient("goal") as client:
        for _ in range(count):
            # Wait for a device that was lost because of high load: it reconnects automatically.
            deadline = time.monotonic() + TIMEOUT_S / 2
            while client.missing() and time.monotonic() < deadline:
                time.sleep(0.2)
            goal = Pose(chance.uniform(-0.08, 0.08), chance.uniform(-0.06, 0.06), 0.0)
            goal = Pose(goal.x, goal.y, chance.uniform(-0.5, 0.5))
            began = time.monotonic()
            client.send(goal)
            end = next((event for event in client.events() if isinstance(event, Finished)), None)
            assert end is not None
            true = client.settled_truth(3.0)
            print(
                json.dumps(
                    {
                        "error_code": end.error_code,
                        "error_msg": end.error_msg,
                        "taps": end.taps,
                        "seconds": time.monotonic() - began,
                        "true_mm": 1e3 * goal.distance_to(true) if true else None,
                        "true_rad": abs(goal.rotation_to(true)) if true else None,
                    }
                ),
                flush=True,
            )


if __name__ == "__main__":
    _send_goals(int(sys.argv[1]))
