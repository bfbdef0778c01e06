"""Actions and measurements of each commissioning step."""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from tapping_cell.calibration.yaml_edit import with_value
from tapping_cell.cli import device_checks
from tapping_cell.cli import session as following
from tapping_cell.cli.check_config import check
from tapping_cell.cli.commissioning.session import Proof, Session, StepFailed, wait
from tapping_cell.cli.graph import Graph
from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.schema import read_yaml
from tapping_cell.configuration.yaml_document import format_yaml
from tapping_cell.durable_file import replace_text
from tapping_cell.hardware.scara import Joints
from tapping_cell.hardware.serial_transport import known_ports
from tapping_cell.nodes.clients.arm_pose_client import ArmPoseClient, ArmRefused
from tapping_cell.nodes.clients.cell_client import CellClient, NotDone
from tapping_cell.nodes.clients.goal_client import GoalClient
from tapping_cell.nodes.clients.single_tap_client import SingleTapClient
from tapping_cell.nodes.conversions import from_message
from tapping_cell.se2 import Pose

READY_S = 90.0
HOMING_S = 180.0
JOINT_STEP = 0.1
"""Rotation (rad) by which each revolute joint is moved to check its direction."""
SPEED = 1.0
"""Speed of the fastest joint, rad/s; in set-up mode a quarter of this speed is used."""
LIMIT_SHARE = 0.9
"""Shoulder and elbow move by this fraction of the distance from the park posture to each limit."""
ARM_POSES, TAPS = 10, 10
OBSERVATIONS = 20
REST_SPREAD = 0.0005
"""Maximum standard deviation of the object's position at rest, m."""
HELD = (0.012, -0.004, 0.3)
"""Pose of the object in the frame striker (m, m, rad) while the simulated arm holds it for the arm
calibration."""
GOAL = Pose(0.02, 0.0, 0.2)
"""Displacement from the object's pose to the first goal: x (m, towards the middle of the table) and
rotation (rad)."""


@dataclass(frozen=True, slots=True)
class Step:
    """One commissioning step."""

    name: str
    title: str
    run: Callable[[Session], Proof]


def files(session: Session) -> Proof:
    """Copy the package's configuration files into the session's folder, and check them."""
    if not session.config.exists():
        # Copy under another name first, so that an incomplete copy is never used.
        part = session.config.with_name("config.part")
        if part.exists():
            shutil.rmtree(part)
        shutil.copytree(shared_folder(), part, ignore=shutil.ignore_patterns("security"))
        part.rename(session.config)
    return _checked(session)


def _checked(session: Session) -> Proof:
    found = check(session.cell_file)
    errors = [f"{one.file}: {error}" for one in found for error in one.errors]
    if errors:
        raise StepFailed("; ".join(errors))
    return Proof(f"{len(found)} files are consistent", {"files": len(found)})


def ports(session: Session) -> Proof:
    """Find the serial ports of arm and tapper. The next step identifies the devices."""
    if not session.hardware:
        return Proof("the simulated cell has its own ports")
    known = ", ".join(known_ports())
    text = session.cell_file.read_text(encoding="utf-8")
    values: dict[str, float | str] = {}
    cell = session.cell()
    if cell.file.tapper.dialect == "io":
        raise StepFailed(
            "tapper.dialect is io: commissioning works in set-up mode, which needs the tapper's"
            ' board; without the board, follow docs/hardware.md, "A digital output"'
        )
    for name, now in (("arm", cell.arm.port), ("tapper", cell.file.tapper.port)):
        port = session.ask(f"serial port of the {name} (found: {known or 'none'})", now)
        if not Path(port).expanduser().exists():
            raise StepFailed(f"the {name}'s port {port} does not exist; found: {known or 'none'}")
        text = with_value(text, f"{name}.port", port)
        values[name] = port
    replace_text(session.cell_file, text)
    return Proof("both ports exist", values)


def connections(session: Session) -> Proof:
    """Identify controller and board, and compare their settings with the cell file."""
    if session.hardware:
        return _device_checks(session.cell_file)
    with session.running(only_world=True) as graph:
        port = session.ports / "arm"
        wait(port.exists, READY_S, "the simulated devices", graph)
        text = session.cell_file.read_text(encoding="utf-8")
        copy = session.config / "cell_with_ports.yaml"
        for name in ("arm", "tapper"):
            text = with_value(text, f"{name}.port", str(session.ports / name))
        replace_text(copy, text)
        try:
            return _device_checks(copy)
        finally:
            copy.unlink()


def _device_checks(cell_file: Path) -> Proof:
    rows = device_checks.check_devices(load_cell(cell_file), write=False)
    wrong = [f"{row.device}, {row.setting}: {row.found} {row.remedy}" for row in rows if not row.ok]
    if wrong:
        raise StepFailed("; ".join(wrong))
    names = {row.device: row.found for row in rows if row.setting in ("controller", "firmware")}
    return Proof(f"{len(rows)} findings, all OK", {"findings": len(rows), **names})


def camera(session: Session) -> Proof:
    """Calibrate the camera from photographs of the printed target."""
    pictures = session.folder / "camera"
    _photographs(session, pictures, "target", 20)
    found = _calibrate(
        session,
        *("camera", str(pictures), "--squares", "10x7", "--square-size", "25"),
        *("--marker-size", "18.75", "--output", str(session.config / "camera_info.yaml")),
    )
    rms = float(found["rms_px"])
    if rms > 1.0:
        raise StepFailed(
            f"reprojection error {rms:.2f} px (limit 1 px): replace the photographs in {pictures} "
            "by sharper ones"
        )
    return Proof(f"reprojection error {rms:.3f} px", {"reprojection_px": round(rms, 4)})


def table(session: Session) -> Proof:
    """Measure the positions of the reference markers."""
    pictures = session.folder / "table"
    _photographs(session, pictures, "table", 6)
    table_file = str(session.config / "table.yaml")
    camera_file = str(session.config / "camera_info.yaml")
    found = _calibrate(
        session,
        *("table", str(pictures), "--table", table_file, "--camera", camera_file),
        *("--output", table_file),
    )
    rms = float(found["rms_px"])
    return Proof(f"reprojection error {rms:.3f} px", {"reprojection_px": round(rms, 4)})


def _calibrate(session: Session, *arguments: str) -> dict[str, Any]:
    """Run a calibration that replaces its file. Return its result."""
    return session.verb("calibrate", *arguments, "--force", "--accept-worse", "--json")


def _calibrate_with_cell(
    session: Session, what: str, number: tuple[str, int], truth: Path | None = None
) -> dict[str, Any]:
    """Record with the running cell and calibrate. ``number``: option and number of measurements."""
    record = session.recording(what)
    resumed = ("--resume",) if record.exists() else ()
    option, count = number
    cell_file = str(session.cell_file)
    with _homed(session, truth=truth):
        return _calibrate(
            session,
            *(what, str(record), "--record", option, str(count), *resumed),
            *("--cell", cell_file, "--output", cell_file),
        )


def _photographs(session: Session, folder: Path, what: str, count: int) -> None:
    """Ask the person for the images, or render them in simulation."""
    if folder.exists() and any(folder.iterdir()):
        return
    if session.hardware:
        folder.mkdir(parents=True, exist_ok=True)
        sheet = "the printed target (calibrate print)" if what == "target" else "the whole table"
        session.instruct(
            f"put {count} photographs of {sheet}, taken by the cell's camera, into {folder}"
        )
        if not any(folder.iterdir()):
            raise StepFailed(f"{folder} is empty")
        return
    session.verb(
        *("calibrate", "photographs", "--what", what, "--count", str(count)),
        *("--output", str(folder), "--seed", str(session.seed)),
    )


def homing(session: Session) -> Proof:
    """Home the arm in set-up mode."""
    session.instruct(
        "make sure that the arm's path is free and hold the enabling device (the page's key, "
        "or the foot switch): the arm homes slowly"
    )
    with session.running(set_up=True) as graph, CellClient() as client:
        began = _home(session, client, graph)
    return Proof(f"homed within {began:.1f} s", {"homing_s": round(began, 1)})


def _home(session: Session, client: CellClient, graph: Graph) -> float:
    """Home the arm and wait until it is idle. Return the duration in s."""

    def arm() -> str:
        return str(client.state()["arm"]["state"])

    known = ("not homed", "idle", "stopped", "fault")
    wait(lambda: arm() in known, READY_S, "the arm's driver", graph)
    if arm() in ("stopped", "fault"):
        _clear(session, client, graph)
    began = time.monotonic()
    deadline = began + READY_S
    while True:
        try:
            client.home()
            break
        except NotDone as refused:
            # The operator may not have pressed the enabling device yet.
            if time.monotonic() > deadline:
                raise StepFailed(str(refused)) from refused
            time.sleep(0.5)
    wait(lambda: arm() != "homing", HOMING_S, "the end of homing", graph)
    if arm() != "idle":
        raise StepFailed(f"the arm is {arm()}: {client.state()['arm']['sentence']}")
    return time.monotonic() - began


def _clear(session: Session, client: CellClient, graph: Graph) -> None:
    """Clear a stop or fault of an earlier session. A stop is stored across restarts."""
    session.instruct(
        f"{client.mode().sentence}: remove the cause, make sure that nobody is near the cell, "
        "and press the clear button at the tapper"
    )
    try:
        if not session.hardware:
            client.press_button()
            time.sleep(1.0)
        client.clear()
    except NotDone as refused:
        raise StepFailed(str(refused)) from refused
    wait(
        lambda: client.mode().word not in ("stopped", "fault"), READY_S, "the end of a stop", graph
    )


@contextmanager
def _homed(session: Session, **options: Any) -> Iterator[tuple[Graph, ArmPoseClient]]:
    """Run a cell with a homed arm that is ready to move."""
    with session.running(**options) as graph:
        with CellClient() as client:
            _home(session, client, graph)
        with ArmPoseClient() as arm:
            wait(lambda: not arm.missing(), READY_S, "an arm that is ready to move", graph)
            yield graph, arm


def joints(session: Session) -> Proof:
    """In set-up mode, move shoulder, elbow and tool a little to check their directions. Then move
    shoulder and elbow almost to their limits."""
    values: dict[str, float | str] = {}
    arm = session.cell().arm
    park = Joints(*arm.park)
    limits = {"lower": Joints(*arm.lower), "upper": Joints(*arm.upper)}
    session.instruct(
        "clear everything within the arm's reach and hold the enabling device: shoulder,"
        " elbow and tool move a little, then shoulder and elbow move almost to their limits"
    )
    with _homed(session, set_up=True) as (graph, client):

        def go(target: Joints) -> None:
            client.go(target, SPEED, graph.check)

        try:
            go(park)
            for name in ("shoulder", "elbow", "tool"):
                moved = _checked_step(session, client, go, name)
                values[f"{name}_step_deg"] = round(math.degrees(moved), 3)
            for name in ("shoulder", "elbow"):
                start = getattr(park, name)
                for side, limit in limits.items():
                    to = start + LIMIT_SHARE * (getattr(limit, name) - start)
                    go(park._replace(**{name: to}))
                    values[f"{name}_{side}_deg"] = round(math.degrees(to), 1)
                go(park)
        except ArmRefused as refused:
            raise StepFailed(str(refused)) from refused
    return Proof(
        "directions confirmed; shoulder and elbow moved 90 % of the way from the park pose to each "
        "limit",
        values,
    )


def _checked_step(
    session: Session, client: ArmPoseClient, go: Callable[[Joints], None], name: str
) -> float:
    """Move one joint a little and back. Return the measured rotation in rad.

    Raises:
        StepFailed: the joint moved too far or not far enough, or in the wrong direction.
        ArmRefused: the arm did not move.
    """
    start = client.joints()
    assert start is not None
    go(start._replace(**{name: getattr(start, name) + JOINT_STEP}))
    here = client.joints()
    assert here is not None
    moved = float(getattr(here, name) - getattr(start, name))
    if abs(moved - JOINT_STEP) > 0.2 * JOINT_STEP:
        raise StepFailed(f"{name} moved {moved:.3f} rad instead of {JOINT_STEP} rad")
    turned = session.ask(f"did the {name} turn counter-clockwise, seen from above?", "yes")
    if not turned.lower().startswith("y"):
        raise StepFailed(
            f"the {name} turns in the wrong direction: reverse this joint's direction in the "
            "controller"
        )
    go(start)
    return moved


def object_at_rest(session: Session) -> Proof:
    """Measure the pose of the object at rest several times."""
    session.instruct("put the object in the middle of the table, with its marker up")
    with _homed(session, set_up=True) as (graph, client):
        places: list[Pose] = []
        seen_at: set[int] = set()

        def measured() -> bool:
            seen = client.object_state
            if seen is not None and seen.visible and seen.at_rest and not seen.error_code:
                stamp = seen.header.stamp.sec * 10**9 + seen.header.stamp.nanosec
                if stamp not in seen_at:
                    seen_at.add(stamp)
                    places.append(from_message(seen.pose.pose))
            return len(places) >= OBSERVATIONS

        wait(measured, READY_S, f"{OBSERVATIONS} measurements of the object at rest", graph)
    spread = float(np.hypot(np.std([p.x for p in places]), np.std([p.y for p in places])))
    if spread > REST_SPREAD:
        raise StepFailed(
            f"the measured position scatters by {1e3 * spread:.2f} mm (limit "
            f"{1e3 * REST_SPREAD} mm): check light and focus"
        )
    last = places[-1]
    return Proof(
        f"measured at x {1e3 * last.x:.1f} mm, y {1e3 * last.y:.1f} mm, "
        f"scatter {1e3 * spread:.4f} mm",
        {
            "x_mm": round(1e3 * last.x, 2),
            "y_mm": round(1e3 * last.y, 2),
            "scatter_mm": spread * 1e3,
        },
    )


def first_tap(session: Session) -> Proof:
    """Make one tap at the lowest energy, in set-up mode."""
    session.instruct(
        "close the guard and hold the enabling device: one tap at the tapper's lowest energy"
    )
    slowest = session.cell().file.tapper.curve().slowest
    with _homed(session, set_up=True) as (graph, _), SingleTapClient() as client:
        following.wait_until_ready(client, READY_S, graph.check, Console(quiet=True))
        result = client.tap(1.001 * slowest, 0.0, math.nan, math.pi, graph.check)
    if result.error_code or not result.record.tap_id:
        raise StepFailed(f"the tap failed ({result.error_code}): {result.error_msg}")
    before = from_message(result.record.object_pose)
    after = from_message(result.record.measured_pose.pose)
    moved = 1e3 * before.distance_to(after)
    return Proof(
        f"striker {1e3 * result.record.striker_speed:.0f} mm/s, the object moved {moved:.2f} mm",
        {"striker_mm_s": 1e3 * result.record.striker_speed, "moved_mm": round(moved, 3)},
    )


def arm(session: Session) -> Proof:
    """Calibrate the arm's base and elbow from camera measurements of a held marker."""
    truth = None
    if not session.hardware:
        content = read_yaml(shared_folder() / "truth" / "default.yaml")
        content["arm"]["holds"] = list(HELD)
        truth = session.folder / "held.yaml"
        replace_text(truth, format_yaml(content))
    session.instruct(
        "attach the object's marker to the striker; the arm will move over the whole table"
    )
    found = _calibrate_with_cell(session, "arm", ("--poses", ARM_POSES), truth)
    rms = 1e3 * float(found["position_rms"])
    if rms > 1.0:
        raise StepFailed(
            f"residual between arm and camera {rms:.2f} mm (limit 1 mm): check that the marker "
            "is firmly attached to the striker, then repeat the measurement with --again arm"
        )
    return Proof(f"residual between arm and camera {rms:.3f} mm", {"residual_mm": round(rms, 4)})


def tapper(session: Session) -> Proof:
    """Measure the striker's speed at several energies."""
    session.instruct(
        "take the marker off the striker, put the object in the middle of the table and close the "
        "guard"
    )
    found = _calibrate_with_cell(session, "tapper", ("--taps", TAPS))
    speeds = found["speeds"]
    return Proof(
        f"{1e3 * speeds[0]:.0f} to {1e3 * speeds[-1]:.0f} mm/s from {found['used']} taps",
        {
            "slowest_mm_s": round(1e3 * speeds[0], 1),
            "fastest_mm_s": round(1e3 * speeds[-1], 1),
            "scatter_percent": round(100 * float(found["scatter"]), 2),
        },
    )


def goal(session: Session) -> Proof:
    """Bring the object to a first goal."""
    session.instruct("make sure that the guard is closed: the cell now works at full speed")
    quiet = Console(quiet=True)
    with _homed(session) as (graph, _), GoalClient() as client:
        following.wait_until_ready(client, READY_S, graph.check, quiet)
        here = client.object_pose()
        target = _first_goal(here)
        client.send(target)
        finished = following.follow(client, graph.check, quiet)
    if finished.error_code:
        raise StepFailed(f"the goal was not reached ({finished.error_code}): {finished.error_msg}")
    distance = 1e3 * finished.residual_distance
    turn = math.degrees(abs(finished.residual_rotation))
    _checked(session)
    return Proof(
        f"reached after {finished.taps} taps, remaining error {distance:.2f} mm, {turn:.2f} deg",
        {"taps": finished.taps, "residual_mm": round(distance, 3), "residual_deg": round(turn, 3)},
    )


def _first_goal(here: Pose) -> Pose:
    """Return the first goal: the object's pose, displaced by GOAL."""
    towards = math.copysign(GOAL.x, -here.x)
    return here._replace(x=here.x + towards, theta=here.theta + GOAL.theta)


STEPS = (
    Step("files", "Files to start from", files),
    Step("ports", "Serial ports", ports),
    Step("connections", "Controller and board", connections),
    Step("camera", "Camera", camera),
    Step("table", "Reference markers", table),
    Step("homing", "Homing", homing),
    Step("joints", "Directions and limits", joints),
    Step("object", "Object", object_at_rest),
    Step("first-tap", "First tap", first_tap),
    Step("arm", "Arm", arm),
    Step("tapper", "Tapper", tapper),
    Step("goal", "First goal", goal),
)
