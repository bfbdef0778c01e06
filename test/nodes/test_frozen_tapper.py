"""If the process of tapper or arm is frozen during a tap, no striker is fired after the arm's
promise to stand still has ended, or while the arm moves.

``TAPPING_CELL_FREEZES=100:7`` freezes each process 100 times, at random times with seed 7.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from harness import bench
from rclpy.duration import Duration
from tapping_cell_msgs.msg import ArmState, TapCommand, TapperState
from tapping_cell_msgs.srv import HoldStill

from tapping_cell.configuration.cell import load_cell
from tapping_cell.nodes import MODULES
from tapping_cell.nodes.cell_node import COMMAND, LATCHED
from tapping_cell.nodes.conversions import to_message
from tapping_cell.se2 import Pose
from tapping_cell.simulation.devices import arm_emulator
from tapping_cell.simulation.pseudo_terminal import PseudoTerminal
from tapping_cell.simulation.tapper_emulator import TapperEmulator
from tapping_cell.simulation.truth import ArmTruth

FREEZES, SEED = map(int, os.environ.get("TAPPING_CELL_FREEZES", "12:5").split(":"))
ARM_FREEZES = FREEZES if "TAPPING_CELL_FREEZES" in os.environ else 3
SPEED_M_S = 0.3
STRIKE, HEIGHT = Pose(-0.08, 0.02, 0.3), load_cell().strike_height
STROKE_M = load_cell().file.tapper.stroke
SERVED = (TapperState.FIRED, TapperState.NOT_FIRED, TapperState.UNKNOWN)


def test_no_shot_is_fired_after_the_arms_promise_to_stand_still_ends(tmp_path: Path) -> None:
    draw = random.Random(SEED)
    device = TapperEmulator(now=time.monotonic())
    fired: dict[int, float] = {}
    device.on_fire = lambda shot, energy, now: fired.__setitem__(shot, now)
    promised: dict[int, float] = {}
    path = tmp_path / "tapper"
    command = [sys.executable, "-m", MODULES["tapper_trigger"], "--ros-args", "-p", f"port:={path}"]
    command += ["-p", "needs_camera:=false"]
    with PseudoTerminal(device, path), bench(lambda: [], {}) as b:
        node = b.probe
        assert node is not None
        states: list[TapperState] = b.listen(TapperState, "tapper_state", LATCHED)
        commands = node.create_publisher(TapCommand, "tap_command", COMMAND)
        arm = node.create_publisher(ArmState, "arm_state", LATCHED)
        freeze_at: list[float] = []
        process = subprocess.Popen(command, env={**os.environ, "HOME": str(tmp_path)})

        def hold(request: HoldStill.Request, response: HoldStill.Response) -> HoldStill.Response:
            promised[request.tap_id] = time.monotonic() + request.duration
            # Freeze the process at a random time between the arm's promise and the shot.
            freeze_at[:] = [time.monotonic() + draw.uniform(0.0, 0.03)]
            response.granted, response.duration = True, request.duration
            return response

        node.create_service(HoldStill, "hold_still", hold)
        try:
            b.wait(lambda: states and states[-1].state == TapperState.SAFE, "the tapper is safe")
            # On a busy machine a tap may end before the arm is asked. If the arm is not asked,
            # nothing is frozen, and the tap does not count.
            for tap_id in range(100, 100 + 6 * FREEZES):
                if len(promised) == FREEZES:
                    break
                tap = TapCommand(request=TapCommand.TAP, tap_id=tap_id, striker_speed=SPEED_M_S)
                tap.header.frame_id = "table"
                now = node.get_clock().now()
                tap.expiry = (now + Duration(seconds=20)).to_msg()
                commands.publish(tap)
                frozen = False

                def step(tap_id: int = tap_id) -> bool:
                    nonlocal frozen
                    message = ArmState(state=ArmState.IN_POSITION, tap_id=tap_id, homed=True)
                    message.header.stamp = node.get_clock().now().to_msg()
                    arm.publish(message)
                    if freeze_at and not frozen:
                        frozen = True
                        time.sleep(max(freeze_at[0] - time.monotonic(), 0.0))
                        process.send_signal(signal.SIGSTOP)
                        time.sleep(draw.uniform(0.15, 0.6))
                        process.send_signal(signal.SIGCONT)
                    time.sleep(0.02)
                    last = states[-1]
                    return last.tap_id == tap_id and last.outcome in SERVED

                b.wait(step, f"tap {tap_id} ends")
                freeze_at.clear()
                b.wait(lambda: states[-1].state == TapperState.SAFE, "safe again")
        finally:
            process.send_signal(signal.SIGCONT)
            process.terminate()
            process.wait(60.0)
    assert len(promised) == FREEZES
    flight = STROKE_M / SPEED_M_S
    late = {shot for shot in fired if fired[shot] + flight > promised[shot]}
    print(f"{FREEZES} freezes (seed {SEED}): {len(fired)} fired, {len(late)} too late")
    assert late == set()


def test_a_frozen_arm_does_not_move_before_the_striker_has_landed(tmp_path: Path) -> None:
    draw = random.Random(SEED)
    board = TapperEmulator(now=time.monotonic())
    arm = arm_emulator(load_cell().file.arm, ArmTruth(), 1, time.monotonic())
    fired: dict[int, tuple[float, bool]] = {}
    board.on_fire = lambda shot, energy, now: fired.__setitem__(shot, (now, arm.moving(now)))
    frozen, moved = 0, list[int]()
    with (
        PseudoTerminal(board, tmp_path / "tapper"),
        PseudoTerminal(arm, tmp_path / "arm"),
        bench(lambda: [], {}) as b,
    ):
        node = b.probe
        assert node is not None
        states: list[TapperState] = b.listen(TapperState, "tapper_state", LATCHED)
        places: list[ArmState] = b.listen(ArmState, "arm_state", LATCHED)
        commands = node.create_publisher(TapCommand, "tap_command", COMMAND)
        options = {
            "tapper_trigger": [f"port:={tmp_path / 'tapper'}", "needs_camera:=false"],
            "scara_arm": [f"port:={tmp_path / 'arm'}", "home_on_activate:=true"],
        }
        processes = {
            name: subprocess.Popen(
                [sys.executable, "-m", MODULES[name], "--ros-args"]
                + [word for value in values for word in ("-p", value)],
                env={**os.environ, "HOME": str(tmp_path)},  # not the stops of other tests
            )
            for name, values in options.items()
        }

        def at_rest() -> bool:
            ready = states and places and commands.get_subscription_count() == 2
            return bool(
                ready and states[-1].state == TapperState.SAFE and places[-1].state == ArmState.IDLE
            )

        def command(request: int, tap_id: int) -> None:
            tap = TapCommand(request=request, tap_id=tap_id, striker_speed=SPEED_M_S)
            tap.header.frame_id = "table"
            tap.strike_pose = to_message(STRIKE, HEIGHT)
            tap.expiry = (node.get_clock().now() + Duration(seconds=20)).to_msg()
            commands.publish(tap)

        def reached(tap_id: int, condition: Callable[[TapperState], bool]) -> bool:
            return any(state.tap_id == tap_id and condition(state) for state in states)

        try:
            b.wait(at_rest, "arm and tapper are ready", 60.0)
            # On a busy machine a tap may end before the arm is asked. A tap that ends so early does
            # not count.
            for tap_id in range(100, 100 + 3 * ARM_FREEZES):
                if frozen == ARM_FREEZES:
                    break
                states.clear()
                command(TapCommand.TAP, tap_id)
                b.wait(
                    lambda tap_id=tap_id: reached(
                        tap_id, lambda s: s.state == TapperState.FIRING or s.outcome in SERVED
                    ),
                    f"tap {tap_id} is fired or given up",
                )
                if reached(tap_id, lambda s: s.state == TapperState.FIRING):
                    frozen += 1
                    time.sleep(draw.uniform(0.0, 0.03))
                    processes["scara_arm"].send_signal(signal.SIGSTOP)
                    command(TapCommand.WITHDRAW, tap_id)
                    time.sleep(draw.uniform(0.05, 0.6))
                    processes["scara_arm"].send_signal(signal.SIGCONT)
                b.wait(
                    lambda tap_id=tap_id: reached(tap_id, lambda s: s.outcome in SERVED),
                    f"tap {tap_id} ends",
                )
                command(TapCommand.WITHDRAW, tap_id)
                # A node that was frozen may report a fault. This is allowed.
                b.wait(lambda: at_rest() or places[-1].state == ArmState.FAULT, "all at rest")
                if tap_id in fired:
                    released, moving = fired[tap_id]
                    landed = released + STROKE_M / SPEED_M_S
                    stood = list(arm.joints(released)) == list(arm.joints(landed))
                    if moving or not stood:
                        moved.append(tap_id)
                if places[-1].state == ArmState.FAULT:
                    break
        finally:
            for process in processes.values():
                process.send_signal(signal.SIGCONT)
                process.terminate()
            for process in processes.values():
                process.wait(60.0)
    print(f"{frozen} freezes of the arm (seed {SEED}): {len(fired)} fired, {moved} while it moved")
    assert frozen
    assert moved == []
