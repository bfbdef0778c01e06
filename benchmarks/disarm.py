"""Time from the loss of planner, arm or camera during charging to the discharge of the striker.

The nodes of a simulated cell run as separate processes. The tapper's board is emulated in this
process. Charging the spring takes several seconds, so that a node can be lost during this time. A
node is killed (``SIGKILL``) or stopped (``SIGSTOP``), or the camera's images stop while its node
keeps running. The benchmark measures the actions of the board, not the reports of the nodes.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import Image
from tapping_cell_msgs.msg import PlanState
from tapping_cell_msgs.srv import ResetWorld

from tapping_cell.cli.graph import Graph, own_domain
from tapping_cell.nodes import MODULES
from tapping_cell.nodes.camera.images import PICTURES
from tapping_cell.nodes.cell_node import COMMAND, LATCHED
from tapping_cell.nodes.clients.goal_client import GoalClient
from tapping_cell.nodes.conversions import to_message
from tapping_cell.se2 import Pose
from tapping_cell.simulation.pseudo_terminal import PseudoTerminal
from tapping_cell.simulation.spring_drive import SpringMechanism
from tapping_cell.simulation.tapper_emulator import TapperEmulator, TapperMachine

DEFAULT_COUNT = 10
"""Number of simulated losses of each kind."""
START, GOAL = Pose(-0.05, 0.02, 0.0), Pose(-0.02, 0.01, 0.2)
SLOW_SPRING = SpringMechanism(step_rate=300.0)
"""Spring whose charging takes several seconds, but less time than the driver's timeout for
charging."""
LATEST_LOSS_S = 1.0
"""Maximum time, in s, from the beginning of charging to the random time at which the node or the
images are lost."""
TIMEOUT_S = 90.0
OVER = (PlanState.IDLE, PlanState.REACHED, PlanState.FAILED, PlanState.CANCELED)
CAMERA = "camera_pose"
NODES = ("sim_world", "tap_planner", "scara_arm", "tapper_trigger")
LOSSES = tuple(
    (who, how) for who in ("tap_planner", "scara_arm", CAMERA) for how in ("kill", "hang")
)
PICTURES_STOP = ("pictures", "stop")


class ChargingCell:
    """A running cell whose planner requests taps. The striker is charged but never fired."""

    def __init__(self, folder: Path) -> None:
        arm, tapper = folder / "arm", folder / "tapper"
        parameters: dict[str, dict[str, object]] = {
            "sim_world": {"arm_port": arm, "tapper_port": folder / "nobody", "seed": 8},
            "scara_arm": {"port": arm, "home_on_activate": True},
            "tapper_trigger": {"port": tapper},
            "tap_planner": {"resume_within": 60.0},
        }
        self.board = TapperEmulator(TapperMachine(SLOW_SPRING), now=time.monotonic())
        self.terminal = PseudoTerminal(self.board, tapper)
        self.graph = Graph(NODES, parameters, folder / "logs", {"HOME": str(folder)})
        self.client = GoalClient("disarm_bench")
        self._log = (folder / "camera_pose.log").open("wb")
        self._phase = PlanState.IDLE
        self.relaying = True
        node = self.client.node
        self._goals = node.create_publisher(PoseStamped, "goal_pose", COMMAND)
        self._reset = node.create_client(ResetWorld, "reset_world")
        node.create_subscription(PlanState, "plan_state", self._on_plan, LATCHED)
        # Images are relayed here, so that they can stop while the camera's node keeps running.
        self._relay = node.create_publisher(Image, "relayed/image_raw", PICTURES)
        node.create_subscription(Image, "camera/image_raw", self._on_image, PICTURES, raw=True)

    def __enter__(self) -> ChargingCell:
        self.terminal.open()
        self.graph.__enter__()
        self.client.__enter__()
        self._start_camera()
        return self

    def __exit__(self, *exception: object) -> None:
        self._camera.kill()
        self._camera.wait()
        self._log.close()
        self.client.__exit__(None, None, None)
        self.graph.stop()
        self.terminal.close()

    def _start_camera(self) -> None:
        command = [sys.executable, "-m", MODULES[CAMERA], "--ros-args"]
        command += ["-r", "camera/image_raw:=relayed/image_raw"]
        self._camera = subprocess.Popen(command, stdout=self._log, stderr=subprocess.STDOUT)

    def _on_image(self, picture: bytes) -> None:
        if self.relaying:
            self._relay.publish(picture)

    def _on_plan(self, message: PlanState) -> None:
        self._phase = message.state

    def wait_for_charging(self) -> None:
        """Wait until the striker is being charged; send a goal if none is active."""
        deadline = time.monotonic() + TIMEOUT_S
        asked = 0.0
        while self.board.state != "CHARGING":
            self.graph.check()
            if time.monotonic() > deadline:
                raise TimeoutError("no striker was charged: " + "; ".join(self.client.missing()))
            idle = self._phase in OVER and not self.client.missing()
            if idle and time.monotonic() > asked + 5.0:
                asked = time.monotonic()
                self._reset.call_async(ResetWorld.Request(object_pose=to_message(START)))
                time.sleep(1.0)
                goal = PoseStamped(pose=to_message(GOAL))
                goal.header.frame_id = "table"
                self._goals.publish(goal)
            time.sleep(0.001)

    def lose(self, who: str, how: str) -> float:
        """Simulate the loss of a node or of the images; return the time in s until the board has
        discharged the striker."""
        began = time.monotonic()
        if who == PICTURES_STOP[0]:
            self.relaying = False
        else:
            os.kill(self._process_of(who), signal.SIGKILL if how == "kill" else signal.SIGSTOP)
        while self.board.state == "CHARGING":
            time.sleep(0.0005)
        return time.monotonic() - began

    def bring_back(self, who: str, how: str) -> None:
        """End the simulated loss."""
        if who == PICTURES_STOP[0]:
            self.relaying = True
        elif how == "hang":
            os.kill(self._process_of(who), signal.SIGCONT)
        elif who == CAMERA:
            self._camera.wait()
            self._start_camera()
        else:
            self.graph.restart(who)

    def _process_of(self, who: str) -> int:
        return self._camera.pid if who == CAMERA else self.graph.process_ids[who]


def measure(count: int) -> dict[str, Any]:
    """Return, for each kind of loss, the times until the striker is discharged, in s."""
    domain = own_domain()
    domain.use()
    chance = random.Random(1)
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder, ChargingCell(Path(folder)) as cell:
        for who, how in (*LOSSES, PICTURES_STOP):
            times = [_loss(cell, who, how, chance.random) for _ in range(count)]
            found[f"{who} {how}"] = {"worst": max(times), "mean": sum(times) / count}
        fired = len(cell.board.fires)
    return {"losses": found, "count": count, "fired": fired, "load": os.getloadavg()[0]}


def _loss(cell: ChargingCell, who: str, how: str, chance: Callable[[], float]) -> float:
    cell.wait_for_charging()
    time.sleep(LATEST_LOSS_S * chance())
    taken = cell.lose(who, how)
    cell.bring_back(who, how)
    return taken


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    rows = [
        f"{name}: discharged after {1e3 * row['mean']:.0f} ms on average and at most "
        f"{1e3 * row['worst']:.0f} ms, in {report['count']} trials"
        for name, row in report["losses"].items()
    ]
    return [*rows, f"fired: {report['fired']}; load {report['load']:.1f}"]
