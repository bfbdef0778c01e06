"""Two simulated cells of one user account at the same time: each has its own world and devices."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from cell_processes import TIMEOUT_S, processes, run, start

from tapping_cell.configuration.files import shared_folder


@contextmanager
def cell(folder: Path, namespace: str, seed: int) -> Iterator[dict[str, str]]:
    """Start a cell with `up`; yield the environment variables for clients of this cell."""
    environment = {**os.environ, "HOME": str(folder)}
    words = ("up", "--no-record", "--wait", "240", "--seed", str(seed), "--namespace", namespace)
    with (folder / f"{namespace}.log").open("w") as output:
        process = start(*words, env=environment, cwd=folder, stdout=output)
        try:
            yield environment
            assert process.poll() is None, (folder / f"{namespace}.log").read_text()
        finally:
            process.terminate()
            process.wait(TIMEOUT_S)


def terminal(process: int) -> str:
    """Return the terminal that a process has open."""
    links = [os.readlink(link) for link in Path(f"/proc/{process}/fd").iterdir()]
    return next((link for link in links if link.startswith("/dev/pts")), "")


@pytest.mark.campaign
def test_two_cells_of_one_domain_reach_their_own_goals(tmp_path: Path) -> None:
    """The cells run in two namespaces. Cells in two domains have other names too
    (``test/nodes/test_cell_identity.py``)."""
    goals = {"left": ("40", "30", "20"), "right": ("-30", "20", "-10")}
    with cell(tmp_path, "left", 4) as first, cell(tmp_path, "right", 5) as second:
        clients = [
            start(
                *("goal", *goal, "--namespace", name, "--wait", "240", "--json"),
                env=environment,
                cwd=tmp_path,
                stderr=None,
            )
            for (name, goal), environment in zip(goals.items(), (first, second), strict=True)
        ]
        answers = [json.loads(client.communicate(timeout=TIMEOUT_S)[0]) for client in clients]
        logs = (tmp_path / "runs" / "up").iterdir()
        terminals = {terminal(processes(log)["scara_arm"]) for log in logs}
        assert len(terminals) == 2 and "" not in terminals, "both arms on one terminal"
    for answer, goal in zip(answers, goals.values(), strict=True):
        assert answer["reached"], answer
        assert answer["final_pose"]["x_mm"] == pytest.approx(float(goal[0]), abs=1.0)
        assert answer["final_pose"]["y_mm"] == pytest.approx(float(goal[1]), abs=1.0)


@pytest.mark.parametrize("given", [(), ("--cell", "cell.yaml")], ids=["none", "a copy"])
def test_hardware_on_the_packaged_example_file_is_refused(
    given: tuple[str, ...], tmp_path: Path
) -> None:
    folder = tmp_path / "config"
    folder.symlink_to(shared_folder())
    status, words = run("up", "--hardware", *given, cwd=folder)
    assert status == 2
    assert "key 'arm.port' is ~/.ros/tapping_cell/{cell}/arm" in words
    assert "a port of the simulated cell" in words
