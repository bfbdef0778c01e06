"""Random faults of a positioning cell: the faults of nodes, and further faults of its boards and
strikers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lab.faults.fault_target import FaultTarget, Made, Maker
from lab.faults.faults import (
    CHECKED,
    MAKERS,
    RELEASED,
    SET_UP_MAKERS,
    draw_duration,
    moment_name,
)
from lab.virtual_cell.fixed_cell import PhysicalFixedCell
from lab.virtual_cell.host import PlannedFreeze
from lab.virtual_cell.network import STRANGER
from tapping_cell.logic.clock import to_stamp
from tapping_cell.logic.poses import to_message
from tapping_cell.messages import PlanState, TapCommand, TapperState
from tapping_cell.se2 import Pose
from tapping_cell.simulation.fault_layer import Direction, FaultKind, random_fault

OUT_S = 2.0
"""Time, in s, for which a striker that was pulled off its mount during a freeze stays off it."""


def _cell_of(trial: FaultTarget) -> PhysicalFixedCell:
    assert isinstance(trial.physical, PhysicalFixedCell)
    return trial.physical


def _any_tapper(rng: np.random.Generator, trial: FaultTarget) -> str:
    names = trial.cell.tapper_names
    return names[int(rng.integers(len(names)))]


def _foreign_command(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """Another program commands a tap of a random tapper, with the id of the last tap or the next
    id."""
    name, ahead = _any_tapper(rng, trial), int(rng.integers(0, 2))
    valid = float(rng.uniform(1.0, 10.0))

    def strike(t: FaultTarget) -> None:
        last = max(t.oracle.commands, default=0)
        if not last:
            return
        model = t.oracle.commands[last]
        entry = next(one for one in t.cell.fixed_tappers.tappers if one.name == name)
        now = t.clocks["tap_planner"].now().ros
        command = TapCommand(
            request=TapCommand.TAP,
            tap_id=last + ahead,
            tapper=name,
            striker_speed=model.striker_speed,
            object_pose=model.object_pose,
            predicted_pose=model.predicted_pose,
            strike_pose=to_message(Pose(*entry.position, entry.direction), t.cell.strike_height),
            expiry=to_stamp(now + round(valid * 1e9)),
        )
        command.header.frame_id = "table"
        command.header.stamp = to_stamp(now)
        t.network.publish(STRANGER, "tap_command", command)

    return strike, (
        f"another program's TAP of '{name}' with the id of the {('last', 'next')[ahead]} tap"
    )


def _stays_out(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """A striker is pulled off its mount, or does not return to it."""
    name, lasting = _any_tapper(rng, trial), draw_duration(rng, 0.02, 5.0)

    def strike(t: FaultTarget) -> None:
        cell = _cell_of(t)
        cell.keep_out(name, True)
        t.scheduler.after(lasting, lambda: cell.keep_out(name, False))

    return strike, f"the striker of '{name}' is off its mount for {lasting:.2f} s"


def _out_in_a_freeze(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """A striker is pulled off its mount while the tapper's process is frozen during a shot."""
    name, job = _any_tapper(rng, trial), ("charge", "fire")[int(rng.integers(2))]
    writes, frozen = int(rng.integers(0, 4)), float(rng.uniform(0.2, 0.45))
    later = float(rng.uniform(0.0, 0.3)) * frozen

    def strike(t: FaultTarget) -> None:
        cell = _cell_of(t)

        def begin() -> None:
            t.scheduler.after(later, lambda: cell.keep_out(name, True))
            t.scheduler.after(later + OUT_S, lambda: cell.keep_out(name, False))

        plan = PlannedFreeze(writes, frozen, job, begin)
        t.processes["tapper_trigger"].freeze_before_write = plan

    return strike, (
        f"tapper_trigger frozen for {frozen:.2f} s before serial write {writes + 1} of the next job"
        f" '{job}'; the striker of '{name}' leaves its mount {later:.3f} s after the freeze began"
    )


def _creep(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """The object is pushed slowly, by less than the limit above which it counts as moved."""
    way, direction = float(rng.uniform(0.0005, 0.0018)), float(rng.uniform(-np.pi, np.pi))
    shift = Pose(way * float(np.cos(direction)), way * float(np.sin(direction)), 0.0)
    lasting = float(rng.uniform(0.2, 1.5))
    return lambda t: t.move_object(shift, lasting), (
        f"the object is pushed by {1e3 * way:.1f} mm within {lasting:.2f} s"
    )


def _blocked(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """A striker does not leave its mount when it is released."""
    name, lasting = _any_tapper(rng, trial), float(rng.uniform(1.0, 8.0))

    def strike(t: FaultTarget) -> None:
        cell = _cell_of(t)
        cell.block(name, True)
        t.scheduler.after(lasting, lambda: cell.block(name, False))

    return strike, f"the striker of '{name}' is blocked for {lasting:.1f} s"


def _board_line(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """The line of one board fails at a random byte."""
    share, direction = float(rng.random()), list(Direction)[int(rng.integers(2))]
    drawn = random_fault(rng, direction, 0, 1500)

    def strike(t: FaultTarget) -> None:
        lines = _cell_of(t).lines
        layer = lines[int(share * len(lines))].layer
        layer.add(replace(drawn, byte=layer.count(direction) + drawn.byte))

    reset = " (the board restarts)" if drawn.kind is FaultKind.RESET else ""
    return strike, f"line of a board: {drawn.kind.value}{reset} after {drawn.byte} bytes"


def _board_power(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """One board loses its power for a moment."""
    share = float(rng.random())

    def strike(t: FaultTarget) -> None:
        cell = _cell_of(t)
        number = int(share * len(cell.boards))
        cell.boards[number].power_cycle(t.scheduler.now)
        cell.lines[number].schedule()

    return strike, "a board loses power"


WITHOUT_ARM = (
    "freeze",
    "freeze at a shot",
    "freeze before a write",
    "freeze at a write",
    "freeze after the last check",
    "kill",
    "restart",
    "deactivate",
    "slow topic",
    "duplicates",
    "replay",
    "foreign withdrawal",
    "foreign outcome",
    "repeated command",
    "second node",
    "clock step",
    "line at a shot",
    "cable at a shot",
    "camera",
    "object moved",
    "object turned",
    "emergency stop",
    "further panel",
    "stop service",
    "stop and reset",
    "guard",
    "cancel",
    "cancel by service",
    "second client",
    "disk full",
    *("exception", "exception in the planner"),
    *("invalid goal", "stop at the cell"),
)
"""Kinds of faults that need no arm."""
FIXED_MAKERS: dict[str, Maker] = {
    **{kind: MAKERS[kind] for kind in WITHOUT_ARM},
    "foreign command": _foreign_command,
    "serial line": _board_line,
    "loss of power": _board_power,
    "striker stays out": _stays_out,
    "striker out in a freeze": _out_in_a_freeze,
    "striker blocked": _blocked,
    "object creeps": _creep,
}
FIXED_SET_UP_MAKERS: dict[str, Maker] = {
    kind: maker for kind, maker in SET_UP_MAKERS.items() if kind != "fast trajectory"
}
"""Additional kinds of faults of a positioning cell in set-up mode."""
FIXED_AT_A_SHOT = (
    *("freeze at a shot", "freeze at a write", "freeze after the last check") * 2,
    *("striker stays out", "striker blocked", "foreign command") * 3,
    *("striker out in a freeze",) * 2,
    *("line at a shot", "cable at a shot", "loss of power") * 2,
    *("object moved", "object creeps", "foreign withdrawal", "repeated command") * 2,
    *("slow topic", "kill", "restart", "deactivate", "cancel", "camera", "emergency stop"),
    *(
        "stop service",
        "stop and reset",
        "guard",
        "clock step",
        "duplicates",
        "second client",
        "object turned",
        "exception",
        "exception in the planner",
        "stop at the cell",
    ),
)
FIXED_OF_A_SHOT = (
    moment_name("plan_state", PlanState.PLACING),
    moment_name("tapper_state", TapperState.CHARGING),
    moment_name("tapper_state", TapperState.FIRING),
    CHECKED,
    RELEASED,
)
FIXED_MOMENTS = (
    moment_name("tapper_state", TapperState.SAFE),
    moment_name("tapper_state", TapperState.CHARGING),
    moment_name("plan_state", PlanState.LOOKING),
    moment_name("plan_state", PlanState.PLACING),
    moment_name("plan_state", PlanState.SETTLING),
)
