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
from collections.abc import Iterator
from pathlib import Path

import pytest
from rosbags.highlevel import AnyReader

from tapping_cell.messages import TapperState
from tapping_cell.nodes import MODULES
from tapping_cell.report.bag import BagError, read_bag

NODES = (
    "sim_world",
    "camera_pose",
    "tap_planner",
    "scara_arm",
    "tapper_trigger",
    "run_recorder",
)


def start(folder: Path, *options: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "tapping_cell", "demo", "--out", str(folder), *options]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=folder.parent
    )


def children_of(folder: Path) -> dict[str, int]:
    """Return, by node name, the process ids of the nodes whose parameters contain the ports of this
    run."""
    found = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            words = (entry / "cmdline").read_bytes().decode().split("\0")
            log = os.readlink(entry / "fd" / "1")
        except OSError:
            continue
        for node in NODES:
            if MODULES[node] in words and log.startswith(str(folder)):
                found[node] = int(entry.name)
    return found


def wait_for_nodes(folder: Path, process: subprocess.Popen[str]) -> dict[str, int]:
    deadline = time.monotonic() + 120
    while len(found := children_of(folder)) < len(NODES):
        assert process.poll() is None, process.stdout.read() if process.stdout else ""
        assert time.monotonic() < deadline, f"only {sorted(found)} came up"
        time.sleep(0.1)
    return found


def wait_for_record(folder: Path, process: subprocess.Popen[str]) -> None:
    """Wait until the bag contains a state of the planner. The recorder writes to the bag twice per
    second."""

    def written() -> bool:
        try:
            return any(True for _ in read_bag(folder / "bag").of("plan_state"))
        except (BagError, OSError):
            return False

    deadline = time.monotonic() + 120
    while not written():
        assert time.monotonic() < deadline and process.poll() is None
        time.sleep(0.1)


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    yield tmp_path / "101"
    assert children_of(tmp_path / "101") == {}, "a node was left behind"


def test_the_demo_reaches_a_goal_and_reports_it_correctly(folder: Path) -> None:
    process = start(folder, "--seed", "5", "--move", "-25", "15", "-12")
    output, _ = process.communicate(timeout=280)
    assert process.returncode == 0, output
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
    again = start(folder)
    output, _ = again.communicate(timeout=150)
    assert again.returncode == 2 and "already contains a run" in " ".join(output.split())


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
            message = reader.deserialize(data, connection.msgtype)
            if connection.topic == "/tapper_state" and message.state == TapperState.CHARGING:
                charged = charged or stamp
    assert counts["/tap_command"] >= taps and counts["/goal_report"] >= 1
    for topic in ("/object_state", "/arm_state", "/tapper_state", "/plan_state"):
        assert first[topic] < first["/tap_command"], topic
    # The recorder subscribes to /ground_truth only when the goal begins, and the first tap may be
    # commanded at the same time. Therefore, the recording of this topic need only begin before the
    # striker is charged.
    assert first["/ground_truth"] < charged
    assert {"/joint_states", "/markers", "/diagnostics", "/camera/camera_info"} <= set(counts)
    assert counts["/camera/image_annotated/compressed"] >= taps
    size = sum(file.stat().st_size for file in (folder / "bag").iterdir())
    assert size < 10e6 * max(1.0, taps / 3)


def test_ctrl_c_during_a_goal_keeps_its_record(folder: Path) -> None:
    process = start(folder, "--move", "100", "0", "90")
    wait_for_nodes(folder, process)
    wait_for_record(folder, process)
    process.send_signal(signal.SIGINT)
    assert process.wait(120) == 130
    content = json.loads((folder / "summary.json").read_text())
    assert (content["outcome"], content["error_code"]) == ("canceled", 111)
    assert content["goal"] is not None and content["reached"] is False
    assert read_bag(folder / "bag").whole


def test_a_killed_recorder_does_not_disturb_the_goal(folder: Path) -> None:
    """A killed recorder is restarted and adds the rest of the run to what it had recorded.

    The goal takes at least four taps, so it is still being executed when the recorder is back.
    """
    process = start(folder, "--seed", "5", "--move", "100", "0", "90")
    nodes = wait_for_nodes(folder, process)
    wait_for_record(folder, process)
    os.kill(nodes["run_recorder"], signal.SIGKILL)
    output, _ = process.communicate(timeout=280)
    assert process.returncode == 0, output
    rest = folder.with_name(folder.name + "_2")
    content = json.loads((rest / "summary.json").read_text())
    assert content["reached"] is True and content["taps"] >= 1
    cut = read_bag(folder / "bag")
    assert not cut.whole and any(True for _ in cut.of("plan_state"))


def test_ctrl_c_ends_every_node_of_a_background_job(folder: Path) -> None:
    """Start the demo with SIGINT ignored, as a shell starts a background job."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        process = start(folder, "--move", "100", "0", "90")
    finally:
        signal.signal(signal.SIGINT, before)
    wait_for_nodes(folder, process)
    time.sleep(3.0)
    process.send_signal(signal.SIGINT)
    assert process.wait(120) == 130
    assert json.loads((folder / "summary.json").read_text())["reached"] is False


def test_a_crashing_node_ends_the_run_and_is_named(folder: Path) -> None:
    process = start(folder, "--move", "100", "0", "90")
    os.kill(wait_for_nodes(folder, process)["camera_pose"], signal.SIGKILL)
    output, _ = process.communicate(timeout=150)
    assert process.returncode == 1
    assert "camera_pose" in output
    content = json.loads((folder / "summary.json").read_text())
    assert content["error_code"] != 0 and "camera_pose" in content["error_msg"]


def test_killing_the_demo_leaves_no_node_running(folder: Path) -> None:
    process = start(folder, "--move", "100", "0", "90")
    nodes = wait_for_nodes(folder, process)
    process.kill()
    process.wait(60)
    deadline = time.monotonic() + 60
    while any(Path(f"/proc/{number}").exists() for number in nodes.values()):
        assert time.monotonic() < deadline, f"left behind: {children_of(folder)}"
        time.sleep(0.1)


def test_a_goal_beyond_the_table_edge_is_refused_with_a_message(folder: Path) -> None:
    process = start(folder, "--goal", "290", "0", "0")
    output, _ = process.communicate(timeout=200)
    assert process.returncode == 1
    content = json.loads((folder / "summary.json").read_text())
    assert (content["error_code"], content["taps"]) == (103, 0)
    for words in ("10.0 mm inside the table's edge", "within +-247.0 mm in x"):
        assert words in content["error_msg"] and words in output.replace("\n", " ")


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("mass: 0.2455", "maas: 0.2455", "unknown key 'maas'"),
        ("shape:", "shape: [", "malformed YAML"),
    ],
    ids=["unknown key", "malformed"],
)
def test_an_invalid_object_file_is_refused_before_any_node_starts(
    folder: Path, tmp_path: Path, old: str, new: str, word: str
) -> None:
    from tapping_cell.configuration.files import shared_folder

    good = (shared_folder() / "objects" / "aluminium_disk.yaml").read_text()
    path = tmp_path / "object.yaml"
    path.write_text(good.replace(old, new, 1))
    process = start(folder, "--object", str(path))
    output, _ = process.communicate(timeout=150)
    assert process.returncode == 2
    assert word in output.replace("\n", " ") and "object.yaml" in output.replace("\n", "")
