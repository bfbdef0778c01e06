"""The verb `demo` in a process of its own: it runs to its end and leaves nothing but a run
folder."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from cell_processes import TIMEOUT_S, processes, run, start
from rosbags.highlevel import AnyReader

from tapping_cell.cli import main
from tapping_cell.cli.graph import RECORDER, SIMULATED
from tapping_cell.configuration.files import shared_folder
from tapping_cell.messages import TapperState
from tapping_cell.report.bag import read_bag
from tapping_cell.report.objects_page import moves_of
from tapping_cell.report.recorded import BagError
from tapping_cell.report.run_folder import read_run

NODES = {*SIMULATED, RECORDER}


def wait(condition: Callable[[], object], process: subprocess.Popen[str], what: str) -> None:
    deadline = time.monotonic() + TIMEOUT_S
    while not condition():
        assert process.poll() is None, process.stdout.read() if process.stdout else ""
        assert time.monotonic() < deadline, f"waited {TIMEOUT_S} s in vain: {what}"
        time.sleep(0.1)


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    yield tmp_path / "101"
    assert processes(tmp_path / "101") == {}, "a node was left behind"


def test_the_demo_reaches_a_goal_and_reports_it_correctly(folder: Path) -> None:
    words = ("demo", "--out", str(folder), "--seed", "5", "--move", "-25", "15", "-12")
    status, output = run(*words, cwd=folder.parent)
    assert status == 0, output
    content = json.loads((folder / "summary.json").read_text())
    assert content["reached"] is True and content["error_code"] == 0 and content["seed"] == 5
    for kind in ("measured_residual", "true_residual"):
        assert content[kind]["distance_mm"] <= 1.0 and content[kind]["rotation_deg"] <= 1.0
    moved = content["goal"]["x_mm"] - content["start"]["x_mm"]
    assert moved == pytest.approx(-25.0)
    with (folder / "taps.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == content["taps"] >= 1
    for row in rows:
        assert row["outcome"] == "fired"
        for axis in ("x_mm", "y_mm"):
            assert abs(float(row[f"measured_{axis}"]) - float(row[f"true_{axis}"])) < 0.2
    assert (folder / "cell.png").stat().st_size > 20_000
    assert "goal reached" in output and "tap 1" in output
    check_bag(folder, len(rows))
    assert f"Goal reached in {len(rows)} tap" in (folder / "report.html").read_text()
    status, output = run("demo", "--out", str(folder), cwd=folder.parent)
    assert status == 2 and "already contains a run" in output


def check_bag(folder: Path, taps: int) -> None:
    """Check that the bag can be read with ROS's types and that the recording begins before the
    first tap."""
    with AnyReader([folder / "bag"]) as reader:
        first = {}
        counts: dict[str, int] = {}
        charged = 0
        for connection, stamp, data in reader.messages():
            first.setdefault(connection.topic, stamp)
            counts[connection.topic] = counts.get(connection.topic, 0) + 1
            if connection.topic == "/tapper_state":
                message = reader.deserialize(data, connection.msgtype)
                if message.state == TapperState.CHARGING:
                    charged = charged or stamp
    assert counts["/tap_command"] >= taps and counts["/goal_report"] >= 1
    for topic in ("/object_states", "/arm_state", "/tapper_state", "/plan_state"):
        assert first[topic] < first["/tap_command"], topic
    # The recorder subscribes to /ground_truth only when the goal begins, and the first tap may be
    # commanded at the same time. Therefore, the recording of this topic need only begin before the
    # striker is charged.
    assert first["/ground_truth"] < charged
    assert {"/joint_states", "/markers", "/diagnostics", "/camera/camera_info"} <= set(counts)
    assert counts["/camera/image_annotated/compressed"] >= taps
    size = sum(file.stat().st_size for file in (folder / "bag").iterdir())
    assert size < 10e6 * max(1.0, taps / 3)


def test_ctrl_c_in_a_background_job_ends_every_node_and_keeps_the_record(folder: Path) -> None:
    """Start the demo with SIGINT ignored, as a shell starts a background job."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        process = start("demo", "--out", str(folder), "--move", "100", "0", "90", cwd=folder.parent)
    finally:
        signal.signal(signal.SIGINT, before)

    def recorded() -> bool:
        """Return whether the bag contains a state of the planner."""
        try:
            return any(True for _ in read_bag(folder / "bag").of("plan_state"))
        except (BagError, OSError):
            return False

    wait(recorded, process, "the goal is recorded")
    process.send_signal(signal.SIGINT)
    assert process.wait(TIMEOUT_S) == 130
    content = json.loads((folder / "summary.json").read_text())
    assert (content["outcome"], content["error_code"]) == ("canceled", 111)
    assert content["goal"] is not None and content["reached"] is False
    assert read_bag(folder / "bag").whole


def test_a_crashing_node_ends_the_run_and_is_named(folder: Path) -> None:
    process = start("demo", "--out", str(folder), cwd=folder.parent)
    wait(lambda: processes(folder).keys() == NODES, process, "the nodes start")
    os.kill(processes(folder)["camera_pose"], signal.SIGKILL)
    output, _ = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 1
    assert "camera_pose" in output
    content = json.loads((folder / "summary.json").read_text())
    assert content["error_code"] != 0 and "camera_pose" in content["error_msg"]


def test_killing_the_program_that_started_a_graph_leaves_no_node_running(folder: Path) -> None:
    code = (
        "import time; from pathlib import Path; from tapping_cell.cli.graph import Graph\n"
        f"with Graph(('tapper_trigger',), {{}}, Path({str(folder)!r})): time.sleep({TIMEOUT_S})"
    )
    process = subprocess.Popen(
        (sys.executable, "-c", code), env={**os.environ, "HOME": str(folder.parent)}
    )
    wait(lambda: processes(folder), process, "the node starts")
    (node,) = processes(folder).values()
    process.kill()
    process.wait(TIMEOUT_S)
    deadline = time.monotonic() + TIMEOUT_S
    while Path(f"/proc/{node}").exists():
        assert time.monotonic() < deadline, "the node runs on"
        time.sleep(0.1)


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("mass: 0.2455", "maas: 0.2455", "unknown key 'maas'"),
        ("shape:", "shape: [", "malformed YAML"),
    ],
    ids=["unknown key", "malformed"],
)
def test_an_invalid_object_file_is_refused_before_any_node_starts(
    old: str,
    new: str,
    word: str,
    folder: Path,
    own_signals: None,
    capsys: pytest.CaptureFixture[str],
) -> None:
    good = (shared_folder() / "objects" / "aluminium_disk.yaml").read_text()
    path = folder.with_name("object.yaml")
    path.write_text(good.replace(old, new, 1))
    assert main(["demo", "--out", str(folder), "--object", str(path)]) == 2
    errors = capsys.readouterr().err
    assert word in errors.replace("\n", " ") and "object.yaml" in errors.replace("\n", "")
    assert not (folder / "logs").exists()


def test_the_demo_of_the_cell_without_an_arm_reaches_a_goal(folder: Path) -> None:
    cell = str(shared_folder() / "positioning_cell" / "cell.yaml")
    options = ("--cell", cell, "--goal", "15", "-20", "60", "--seed", "2")
    status, output = run("demo", "--out", str(folder), *options, cwd=folder.parent)
    assert status == 0, output
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    assert summary["reached"]
    assert summary["true_residual"]["distance_mm"] <= 1.0
    assert abs(summary["true_residual"]["rotation_deg"]) <= 1.0
    assert not (folder / "logs" / "scara_arm.log").exists()
    # On a busy machine the emulated board may answer late. A log may contain a warning about this,
    # but no traceback.
    for log in (folder / "logs").glob("*.log"):
        assert "Traceback" not in log.read_text(encoding="utf-8"), log


def test_the_demo_brings_two_objects_to_their_goals_without_contact(folder: Path) -> None:
    """Objects that swap their places are tested in ``test/pure/planning/test_arrangement.py``."""
    words = ("demo", "--out", str(folder), "--objects", "2", "--seed", "20")
    status, output = run(*words, cwd=folder.parent)
    assert status == 0, output
    told = json.loads((folder / "summary.json").read_text())
    assert told["reached"] and told["contacts"] == []
    made = read_run(folder)
    assert len(made.objects) == 2 and len(made.taps) == told["taps"]
    for one in made.objects:
        assert one.goal is not None and one.end_true is not None
        assert one.end_true.distance_to(one.goal) <= one.tolerance[0]
    assert len(moves_of(made)) >= 2
    assert (folder / "report.html").stat().st_size > 10_000
