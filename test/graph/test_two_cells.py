"""Two simulated cells of one user account at the same time: each has its own world and devices."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tapping_cell.cli.graph import own_domain
from tapping_cell.configuration.files import shared_folder
from tapping_cell.nodes import MODULES

CELL = (sys.executable, "-m", "tapping_cell")


@contextmanager
def cell(folder: Path, domain: int, namespace: str, seed: int) -> Iterator[dict[str, str]]:
    """Start a cell with `up`; yield the environment variables for clients of this cell."""
    environment = {**os.environ, "HOME": str(folder), "ROS_DOMAIN_ID": str(domain)}
    command = (*CELL, "up", "--no-record", "--seed", str(seed), "--namespace", namespace)
    process = subprocess.Popen(
        command, env=environment, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    try:
        yield environment
        assert process.poll() is None, process.stdout.read() if process.stdout else ""
    finally:
        process.terminate()
        process.communicate(timeout=120)


def arm_terminals() -> dict[int, str]:
    """Return the terminal that each running scara_arm has open, by process id."""
    found = {}
    for entry in Path("/proc").iterdir():
        try:
            words = (entry / "cmdline").read_bytes().decode().split("\0")
            if MODULES["scara_arm"] not in words or not entry.name.isdigit():
                continue
            links = [os.readlink(link) for link in (entry / "fd").iterdir()]
        except OSError:
            continue
        found[int(entry.name)] = next((link for link in links if link.startswith("/dev/pts")), "")
    return found


@pytest.mark.parametrize("names", [("", ""), ("left", "right")], ids=["domains", "namespaces"])
def test_two_cells_of_one_user_account_reach_their_own_goals(
    names: tuple[str, str], tmp_path: Path
) -> None:
    """The cells run in two domains, or in two namespaces of one domain."""
    domain = own_domain_beside()
    domains = (domain, domain if names[0] else own_domain_beside())
    goals = (("40", "30", "20"), ("-30", "20", "-10"))
    before = set(arm_terminals())
    with (
        cell(tmp_path, domains[0], names[0], seed=4) as first,
        cell(tmp_path, domains[1], names[1], seed=5) as second,
    ):
        clients = [
            subprocess.Popen(
                (*CELL, "goal", *goal, "--namespace", name, "--wait", "180", "--json"),
                env=environment,
                cwd=tmp_path,
                stdout=subprocess.PIPE,
                text=True,
            )
            for goal, name, environment in zip(goals, names, (first, second), strict=True)
        ]
        answers = [json.loads(client.communicate(timeout=280)[0]) for client in clients]
        terminals = {
            terminal for process, terminal in arm_terminals().items() if process not in before
        }
        assert len(terminals) == 2 and "" not in terminals, "both arms on one terminal"
    for answer, goal in zip(answers, goals, strict=True):
        assert answer["reached"], answer
        assert answer["final_pose"]["x_mm"] == pytest.approx(float(goal[0]), abs=1.0)
        assert answer["final_pose"]["y_mm"] == pytest.approx(float(goal[1]), abs=1.0)


def own_domain_beside() -> int:
    """Reserve another ROS domain for this process, in addition to the domain of the tests."""
    chosen = os.environ.pop("ROS_DOMAIN_ID")
    try:
        held = own_domain()
        _HELD.append(held)
        return held.number
    finally:
        os.environ["ROS_DOMAIN_ID"] = chosen


_HELD: list[object] = []


@pytest.mark.parametrize("given", [(), ("--cell", "cell.yaml")], ids=["none", "a copy"])
def test_hardware_on_the_packaged_example_file_is_refused(
    given: tuple[str, ...], tmp_path: Path
) -> None:
    folder = tmp_path / "config"
    folder.symlink_to(shared_folder())
    ended = subprocess.run(
        (*CELL, "up", "--hardware", *given), cwd=folder, capture_output=True, text=True, timeout=150
    )
    assert ended.returncode == 2
    words = " ".join(ended.stderr.split())
    assert "key 'arm.port' is ~/.ros/tapping_cell/{cell}/arm" in words
    assert "a port of the simulated cell" in words
