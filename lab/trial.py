"""Run of one cell in virtual time, with operators, goals and faults, from one seed."""

from __future__ import annotations

import math
import traceback
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any

import numpy as np

from lab.faults.fault_target import Maker
from lab.faults.faults import (
    ALL,
    ARM_ASKED,
    ARM_PROMISED,
    ASK_MAKERS,
    AT_A_SHOT,
    CHECKED,
    MAKERS,
    MODE_SHARE,
    MOMENTS,
    NODES,
    OF_A_SHOT,
    RELEASED,
    SET_UP_MAKERS,
    Fault,
    Mix,
    Moment,
    draw_duration,
    draw_faults,
    moment_name,
)
from lab.faults.invalid_commands import draw_wrong_field
from lab.oracle.confirmation import ConfirmationOracle
from lab.oracle.oracle import Oracle, Request, Violation
from lab.oracle.set_up import SetUpOracle
from lab.virtual_cell.camera import Camera
from lab.virtual_cell.checked_arm import CheckedArm
from lab.virtual_cell.further_panels import FurtherPanels, PanelPress
from lab.virtual_cell.host import (
    HostClock,
    Process,
    Program,
    UnhandledDefectError,
    copy_of,
)
from lab.virtual_cell.network import STRANGER, Network, Quality
from lab.virtual_cell.people import KEY, SWITCH, ConfirmingPerson, EnablingPerson
from lab.virtual_cell.physical_cell import PhysicalCell
from lab.virtual_cell.planted_exception import PlantedException
from lab.virtual_cell.scheduler import HangError, Scheduler
from lab.virtual_cell.serial_line import BusyLine, SerialLine
from tapping_cell.configuration.arm_assembly import make_arm_driver
from tapping_cell.configuration.cell import Cell, load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.objects import ObjectFile
from tapping_cell.configuration.schema import load
from tapping_cell.hardware.arm import ArmDriver
from tapping_cell.hardware.scara import Joints
from tapping_cell.hardware.tapper import TapperDriver, TapperSettings
from tapping_cell.hardware.tapper_protocol import Mode
from tapping_cell.logic import arm_jobs
from tapping_cell.logic.arm import ArmLogic, ArmOptions
from tapping_cell.logic.clock import NANOSECONDS, Now, to_stamp
from tapping_cell.logic.goal_handling import GoalHandling
from tapping_cell.logic.host import Logic
from tapping_cell.logic.objects_on_table import ObjectsOnTable
from tapping_cell.logic.planner import PlannerLogic
from tapping_cell.logic.planner_settings import PlannerSettings
from tapping_cell.logic.poses import from_message, to_message
from tapping_cell.logic.table_maps import TableMaps
from tapping_cell.logic.tapper import TapperLogic, TapperOptions
from tapping_cell.logic.tapper_peers import ARM_HIDES_S, PeerLimits
from tapping_cell.messages import (
    ArmState,
    Bool,
    ErrorCode,
    JointTrajectory,
    JointTrajectoryPoint,
    ObjectState,
    ObjectStates,
    PlanState,
    PoseStamped,
    PositionObject,
    SetBool,
    TapCommand,
    TapperState,
    Trigger,
)
from tapping_cell.se2 import Pose
from tapping_cell.simulation.grbl_emulator import GrblEmulator
from tapping_cell.simulation.tapper_emulator import TapperEmulator
from tapping_cell.simulation.truth import TruthFile

STATE = Quality(latched=True, depth=1)
"""Quality of service of a state topic: only its last message is kept."""
QUALITIES = {
    "arm_state": STATE,
    "tapper_state": STATE,
    "object_states": STATE,
    "unknown_objects": STATE,
    "plan_state": STATE,
    "markers": STATE,
    "camera/pose": STATE,
    # A node also has volatile subscriptions to this topic, whose depth is that of commands.
    "emergency_stop": Quality(latched=True),
}
SUBSCRIPTIONS = {
    "tap_planner": (
        "goal_pose",
        "object_states",
        "unknown_objects",
        "camera/pose",
        "arm_state",
        "tapper_state",
        "emergency_stop",
    ),
    "scara_arm": (
        "tap_command",
        "tapper_state",
        "joint_trajectory",
        "enabling",
        "plan_state",
        "camera/pose",
        "emergency_stop",
    ),
    "tapper_trigger": (
        "tap_command",
        "arm_state",
        "plan_state",
        "object_states",
        "enabling",
        "emergency_stop",
    ),
}
SERVES = {
    "tap_planner": ("confirm_tap",),
    "scara_arm": ("~/home", "~/stop", "~/clear_fault", "hold_still"),
    "tapper_trigger": ("~/stop", "~/clear_fault"),
}
CAMERA_SIGMA = (5e-6, 5e-6, 5e-5)
"""Standard deviation of the pose in one frame: m, m, rad."""
NOTICED_S = 0.7
"""Addition to the time for which the object may be unseen before a shot, which allows for delayed
messages and for the board's firing window, s."""
GOAL_TIME_LIMIT_S = 120.0
SHARE_OF_SHORT_LIMITS, SHORT_LIMIT_S = 0.2, (2.0, 25.0)
"""Fraction of the runs whose goals have a short time limit, and the range of that limit in s."""
QUIET_S = 80.0
"""Time after which no fault of a run has an effect any more, s."""
SHARE_OF_QUIET_ENDS = 0.2
"""Fraction of the runs that end with a goal without a fault, which must be reached."""
INSTRUCTION = "clear the stop again within"
"""Part of the message of a refusal to clear that asks a person to confirm."""
SIMULATOR_DEFECT = "simulator defect"
"""Name of the violation that an exception of the simulator itself causes."""
SHARE_OF_FEW_TAPS, MOST_TAPS = 0.1, 3
"""Fraction of the runs whose goals have a small limit of taps, and the maximum of that limit."""
SHARE_OF_ONE_FRAME = 0.25
"""Fraction of the runs in which the planner decides on a single frame of the object at rest."""
SHARE_OF_SET_UP, SHARE_OF_ASKS = 0.1, 0.1
"""Fraction of the runs in set-up mode, and of the runs that ask a person before every tap."""
FROM_START, OF_GOAL, ON_REQUEST = "from the start", "of each goal", "on request"
"""Ways in which the planner is told to ask before every tap."""
CONFIRM_S = 15.0
"""Time for which the planner waits for a person's answer, s."""
SHARE_OF_UNENABLED_HOMING, SHARE_OF_UNENABLED_TAPS = 0.1, 0.2
"""Fractions of the requests to home, and of other programs' taps, in set-up mode before which the
person releases the enabling device."""
PROGRAM_TAPS = 1.0
"""Mean number of taps that a program commands after each goal."""
SHARE_OF_CONFLICTS = 0.1
"""Fraction of the taps of the program for which a second program commands another tap with the same
id. The program commands taps after each goal."""
PROGRAM_TIMEOUT_S, PROGRAM_EXPIRY_S = 12.0, 10.0
"""Time for which the program waits for the outcome of its tap, and time until the tap expires."""
SHARE_OF_STOPS_AT_A_CLEAR, STOP_AT_A_CLEAR_S = 0.1, 0.5
"""Fraction of the requests to clear a node after which somebody stops the node again, and the
maximum time from the request to this stop, s."""
SHARE_OF_STOPS_AT_A_REFUSAL, STOP_AT_A_REFUSAL_S = 0.2, (0.01, 0.9)
"""Fraction of the refusals that ask for a confirmation after which a further panel is pressed and
vanishes, and the range of the time from the refusal to this stop, s."""
SHARE_OF_REPEATED_REQUESTS, REPEATED_AFTER_S = 0.1, (0.02, 0.25)
"""Fraction of the requests to clear a node that are repeated before they are answered, as by a
double click, and the range of the time between the two requests, s."""
SHARE_OF_ABSENCES, ABSENCE_S = 0.15, (25.0, 36.0)
"""Fraction of the refusals that ask for a confirmation after which the person does something else
first, and the range of the duration, s. A confirmation counts for 30 s."""
SHARE_OF_SHORT_EXPIRIES, SHORT_EXPIRY_S = 0.1, (0.2, 4.0)
"""Fraction of the taps of other programs that expire soon, and the range of their expiry, s."""
SHARE_OF_FUTURE_STAMPS, FUTURE_STAMP_S = 0.05, (1.5, 3600.0)
"""Fraction of the taps of other programs with a stamp in the future, and the range by which this
stamp is ahead of the clock, s."""
SHARE_OF_TOLERANCES, WIDER = 0.3, (1.0, 1.5, 2.2, 3.0)
"""Fraction of the goals with a tolerance of their own, and its possible values as multiples of the
cell's tolerance. A few values, because solving the plan of a further tolerance takes as long as one
goal."""
SHARE_OF_REPEATED_GOALS = 0.3
"""Fraction of the failed goals that are requested again, in runs that ask a person."""
SHARE_OF_DAMAGED_STOPS = 0.2
"""Fraction of the stored stops that are damaged when their node is killed."""
SHARE_OF_INVALID_TAPS = 0.15
"""Fraction of the taps of other programs with a wrong field."""
SHARE_OF_FORGOTTEN_TAPS = 0.1
"""Fraction of the taps of other programs that are not withdrawn at the end."""
GOAL_SLACK_S = 5.0
"""Maximum time from a goal's time limit to the goal's end, if the planner's process is running."""
HAND_STEP_S = 1 / 60
"""Time between the small steps in which a hand moves the object slowly, s."""
CANCEL_S = 0.5
"""Maximum time from when the planner's process handles a cancellation until the goal ends, s."""
HOME_AFTER_S = 0.5
"""Time from the request to clear the arm's stop to the request to home the arm, s."""
MEMORY_S, MOVED_M = 5.0, 0.002
"""Settings of the planner for the other objects: time after which an object that is not seen counts
as removed, s, and displacement that counts as motion, m."""
RECOVERY_S = 90.0
"""Maximum time for a person to recover the cell before the next goal."""


DIALECTS = ("grbl", "grbl", "marlin")
"""Controllers of the arm; the seed selects one. After a loss of power, Marlin raises no alarm."""
OBJECTS = ("aluminium_disk", "aluminium_square", "plexiglas_disk")
"""Names of the object files; the seed selects one. Most runs use the first one."""
SHARE_OF_OTHER_SHAPES, SHARE_OF_PROBES = 0.2, 0.1
"""Fraction of the runs with another object than the first one, and of the runs whose goals begin
with a few of the smallest taps, which estimate the object's friction."""


@cache
def shipped_cell(dialect: str = "grbl", tapped: str = OBJECTS[0]) -> Cell:
    """Return the default cell of the package with this controller of the arm. ``tapped``: name of
    the object's file, without its folder and suffix."""
    cell = load_cell(object_path=shared_folder() / "objects" / f"{tapped}.yaml")
    return replace(cell, file=replace(cell.file, arm=replace(cell.arm, dialect=dialect)))


@cache
def table_maps(tapped: str = OBJECTS[0]) -> TableMaps:
    """Return the maps that all runs of this process share, for an object as in ``shipped_cell``."""
    return TableMaps(shipped_cell(tapped=tapped))


@dataclass(slots=True)
class GoalOutcome:
    """Outcome of one goal."""

    number: int
    code: int
    sentence: str
    duration: float
    taps: int
    faults: tuple[str, ...]


@dataclass(slots=True)
class Report:
    """Results of one run."""

    seed: int
    outcomes: list[GoalOutcome] = field(default_factory=list)
    violations: list[Violation] = field(default_factory=list)
    faults: Counter[str] = field(default_factory=Counter)
    by_node: Counter[str] = field(default_factory=Counter)
    """Counts of the faults that were injected into each node, by kind and node, such as "freeze
    scara_arm"."""
    releases: int = 0
    program_taps: int = 0
    cell_seconds: float = 0.0
    trace: list[str] = field(default_factory=list)


class Trial:
    """The complete cell of one seed. Times are in s from the start of the run."""

    devices: tuple[str, ...] = ("tapper_trigger", "scara_arm")
    """Nodes that drive a device."""
    nodes: tuple[str, ...] = NODES
    arm_node = "scara_arm"
    """Name of the node in which faults of the arm's node are injected."""
    makers: Mapping[str, Maker] = MAKERS
    at_a_shot: tuple[str, ...] = AT_A_SHOT
    of_a_shot: tuple[str, ...] = OF_A_SHOT
    moments: tuple[str, ...] = MOMENTS
    goal_handling: type[GoalHandling] = GoalHandling
    has_set_up, has_confirmation = True, True
    """Whether some runs are in set-up mode, or ask a person before every tap."""
    set_up_makers: Mapping[str, Maker] = SET_UP_MAKERS

    def __init__(
        self,
        seed: int,
        trace: bool = False,
        *,
        faults: bool = True,
        mix: Mix = ALL,
    ) -> None:
        """``faults``: whether to inject faults; ``mix``: distribution of the faults."""
        self._mix = mix
        self.seed = seed
        self._faulty = faults
        self.rng = np.random.default_rng([seed, 0])
        self._fault_rng = np.random.default_rng([seed, 1])
        self.scheduler = Scheduler()
        self.report = Report(seed)
        self._tracing = trace
        self._mode_rng = np.random.default_rng([seed, 6])
        self.set_up = self._draw_mode(self.has_set_up, mix.set_up, SHARE_OF_SET_UP)
        """Whether the cell is in set-up mode."""
        self.asks = ""
        """How the planner is told to ask before every tap; empty: not at all."""
        if self._draw_mode(self.has_confirmation, mix.ask, SHARE_OF_ASKS):
            ways = (FROM_START, OF_GOAL, ON_REQUEST)
            self.asks = ways[int(self._mode_rng.integers(len(ways)))]
        if self.set_up:
            self.makers = {**self.makers, **self.set_up_makers}
            self.at_a_shot = (*self.at_a_shot, *tuple(self.set_up_makers) * MODE_SHARE)
        if self.asks:
            self.makers = {**self.makers, **ASK_MAKERS}
            self.at_a_shot = (*self.at_a_shot, *tuple(ASK_MAKERS) * MODE_SHARE)
        variants = np.random.default_rng([seed, 25])
        self._tapped = OBJECTS[0]
        if variants.random() < SHARE_OF_OTHER_SHAPES:
            self._tapped = OBJECTS[1 + int(variants.integers(len(OBJECTS) - 1))]
        self._probes = bool(variants.random() < SHARE_OF_PROBES)
        self.cell = self._make_cell(seed)
        truth = load(TruthFile, shared_folder() / "truth" / "default.yaml")
        self.physical = self._make_physical(truth, seed)
        self.network = Network(self.scheduler, np.random.default_rng([seed, 2]), QUALITIES)
        self.joint_names: tuple[str, ...] = Joints._fields
        # In set-up mode, the arm would hide the object for longer than the tapper tolerates.
        self.arm_covers = self._covers() and not self.set_up
        short = bool(self.rng.random() < SHARE_OF_SHORT_LIMITS)
        limits = np.random.default_rng([seed, 23])
        few = limits.random() < SHARE_OF_FEW_TAPS
        self.tap_limit = int(limits.integers(1, MOST_TAPS + 1)) if few and faults else 0
        """Limit of the number of taps that the goals request; 0: the limit of the cell's file."""
        self.settings = PlannerSettings(
            goal_time_limit=self._draw_limit(short),
            frames_needed=1 if self.rng.random() < SHARE_OF_ONE_FRAME else 5,
            ask=self.asks == FROM_START,
            confirm_deadline=CONFIRM_S,
        )
        self._computers = {name: self._make_clock() for name in ("planner", "drivers", "camera")}
        self.clocks = {
            "tap_planner": self._computers["planner"],
            "scara_arm": self._computers["drivers"],
            "tapper_trigger": self._computers["drivers"],
            "camera_pose": self._computers["camera"],
        }
        self.oracle = self._make_oracle(ARM_HIDES_S if self.arm_covers else PeerLimits().unseen)
        self.confirmation: ConfirmationOracle | None = None
        self.enabling: SetUpOracle | None = None
        self._people_rng = np.random.default_rng([seed, 11])
        self._request_rng = np.random.default_rng([seed, 27])
        self._goal_limit = self.settings.goal_time_limit
        """Time limit of the last goal, s."""
        self._last_goal: Pose | None = None
        self._program_rng = np.random.default_rng([seed, 26])
        self._spoilt_id = 0
        """Last id of a command of another program with a wrong field."""
        self.held_since = math.inf
        """Time since which an emergency stop is held."""
        self.panels = FurtherPanels(
            self.scheduler, self.network, self._hold_emergency_stop, self._end_hold
        )
        self._away_until = -math.inf
        """Time until which the person who recovers the cell does something else."""
        self.network.on_publish = self._on_publish
        self.network.on_call = self._on_call
        self.network.on_answer = self._on_answer
        self.scheduler.after_event = self._after_event
        self.physical.on_release = lambda: self._reached(RELEASED)
        self.processes = {
            name: Process(
                name,
                program,
                self.scheduler,
                self.network,
                self.clocks[name],
                lambda low, high: float(self.rng.uniform(low, high)),
            )
            for name, program in self._programs(*self._lines()).items()
        }
        for process in self.processes.values():
            process.on_handled = self._on_handled
            process.on_asked = self._on_asked
            process.on_requested = self._on_requested
            process.on_lifecycle = self._on_lifecycle
            process.on_log = self._on_log
            process.on_planted = self._on_planted
        self._seconds: list[Process] = []
        self.camera = self._make_camera()
        self._enabler: EnablingPerson | None = None
        self._checked_releases = 0
        if self.set_up:
            self._bring_enabler()
        if self.asks:
            self._bring_confirmer()
        self._hidden_until = -math.inf
        self._token = 0
        self._goal_token = 0
        """Token of the action goal that has not ended; 0 if there is none."""
        self._result: PositionObject.Result | None = None
        self._pressed_until = -math.inf
        self._pressed_at = -math.inf
        self._asked_to_clear: dict[str, float] = {}
        """Nodes that were asked to clear since their last stop, and the times of the requests. Such
        a request may be handled late and is valid if the emergency stop has been released by
        then."""
        self._waiting_faults: list[Fault] = []
        self._taps_of_arm: set[int] = set()
        """Taps that the arm's process has received since it was last stopped or started. Only a
        withdrawal of one of these taps may make the arm move."""
        self._moments: Counter[str] = Counter()
        self._states: dict[str, int] = {}
        self._last_reports: dict[tuple[str, str], str] = {}
        self.network.publish("panel", "emergency_stop", Bool(data=False))
        lens = PoseStamped()
        place = lens.pose.position
        place.x, place.y, place.z = truth.camera.position
        self.network.publish("camera_pose", "camera/pose", lens)

    # People of the modes

    def _draw_mode(self, possible: bool, always: bool, share: float) -> bool:
        drawn = bool(self._mode_rng.random() < share)
        return possible and (always or drawn)

    def _draw_limit(self, short: bool) -> float:
        """Return the time limit of the goals, s."""
        limit = draw_duration(self.rng, *SHORT_LIMIT_S) if short else GOAL_TIME_LIMIT_S
        return limit if self._faulty else GOAL_TIME_LIMIT_S

    def _bring_enabler(self) -> None:
        """Let a person hold the enabling device, and check set-up mode."""

        def arm_runs_since() -> float:
            arm = self.processes.get("scara_arm")
            return arm.runs_since if arm is not None and arm.configured else math.inf

        enabling = SetUpOracle(
            self.scheduler,
            self.physical,
            self.oracle.violate,
            arm_runs_since,
            lambda: self.processes["tapper_trigger"].frozen_until,
        )
        self.enabling = enabling

        def set_switch(held: bool) -> None:
            self.physical.set_enabling_switch(held)
            enabling.on_switch(held)

        rng = np.random.default_rng([self.seed, 7])
        self._enabler = EnablingPerson(self.scheduler, self.network, set_switch, rng)

    def _bring_confirmer(self) -> None:
        """Let a person confirm the taps, and check the confirmations."""
        self.confirmation = ConfirmationOracle(
            self.scheduler, self.oracle.violate, self.settings.ask
        )
        rng = np.random.default_rng([self.seed, 8])
        ConfirmingPerson(
            self.scheduler,
            self.network,
            rng,
            lambda kind: self._note(f"PERSON {kind}"),
            self._faulty,
        )

    def release_enabling(self, devices: tuple[str, ...], silent: bool, away: float) -> None:
        """Let the person of set-up mode release these devices for ``away`` s. ``silent``: the key's
        messages just end."""
        if self._enabler is not None:
            self._enabler.release(devices, silent, away)

    def change_ask(self, ask: bool) -> None:
        """Tell the planner whether to ask before every tap."""
        process, confirmation = self.processes["tap_planner"], self.confirmation
        if process.alive and confirmation is not None:
            self._token += 1
            request, token = SetBool.Request(data=ask), ("person", self._token)
            process.request("ask", request, token, lambda _: setattr(confirmation, "asks", ask))

    # Methods that other kinds of cells override.

    def _make_cell(self, seed: int) -> Cell:
        return shipped_cell(DIALECTS[seed % len(DIALECTS)], self._tapped)

    def _make_physical(self, truth: TruthFile, seed: int) -> PhysicalCell:
        return PhysicalCell(self.scheduler, self.cell, truth, seed)

    def _make_oracle(self, unseen: float) -> Oracle:
        """Return the oracle. ``unseen``: time for which the object may be unseen at a shot, s."""
        clock = self.clocks["tapper_trigger"]
        return Oracle(self.scheduler, self.physical, self.network, clock, unseen + NOTICED_S)

    def _make_camera(self) -> Camera:
        return Camera(
            self.scheduler,
            np.random.default_rng([self.seed, 3]),
            self._observe,
            lambda: self.clocks["camera_pose"].now().ros,
            lambda states: self.network.publish("camera_pose", "object_states", states),
            self.cell.object.name,
            CAMERA_SIGMA,
        )

    def _connect_planner(self, _: Any, __: float, now: Now) -> GoalHandling:
        """Return the goal handling of a planner that configures itself now."""
        return self.goal_handling(
            self.cell,
            "",
            ObjectsOnTable((self.cell.object, *self._other_files()), MEMORY_S, MOVED_M),
            now,
            adapt=True,
            probe=self._probes,
            keep_for="",
            time_limit=self.settings.goal_time_limit,
            maps=self._maps(),
            solve_in_background=False,
        )

    def _other_files(self) -> tuple[ObjectFile, ...]:
        """Return the files of the objects besides the cell's own."""
        return ()

    def _maps(self) -> TableMaps | None:
        return table_maps(self._tapped)

    def _request(self, message: PoseStamped) -> tuple[str, Any, Request]:
        """Return the action and its goal, and what the oracle knows of this goal."""
        asks = self.asks == OF_GOAL
        if asks and self.confirmation is not None:
            self.confirmation.asks = True
        position, angle = self.cell.tolerance
        goal = PositionObject.Goal(goal_pose=message, ask=asks, max_taps=self.tap_limit)
        if self._faulty and self._request_rng.random() < SHARE_OF_TOLERANCES:
            goal.position_tolerance = position = position * float(self._request_rng.choice(WIDER))
            goal.angle_tolerance = angle = angle * float(self._request_rng.choice(WIDER))
        if self._faulty and self._request_rng.random() < SHARE_OF_SHORT_LIMITS:
            self._goal_limit = draw_duration(self._request_rng, *SHORT_LIMIT_S)
        if self._goal_limit != self.settings.goal_time_limit:
            goal.time_limit = self._goal_limit
        goals = {self.cell.object.name: from_message(message.pose)}
        return "position_object", goal, self.oracle.on_goal_sent(goals, (position, angle))

    def _put_back(self) -> None:
        """Put the object back in the middle of the table."""
        self.physical.world.place(Pose(0.0, 0.0, 0.0))
        self.oracle.note_hand()

    def _covers(self) -> bool:
        """Choose at random whether the arm can cover the object."""
        return bool(self.rng.random() < 0.5)

    def _lines(self) -> tuple[SerialLine, ...]:
        """Return the lines for ``_programs``."""
        return self.physical.arm_line, self.physical.tapper_line

    def _busy_lines(self) -> tuple[SerialLine, ...]:
        """Return the lines for ``_programs`` of a second instance of a node. These lines cannot be
        opened, because the first instance uses them."""
        physical = self.physical
        return (
            BusyLine(self.scheduler, physical.arm_line.layer, "arm"),
            BusyLine(self.scheduler, physical.tapper_line.layer, "tapper"),
        )

    def _make_clock(self) -> HostClock:
        rng = self.rng
        return HostClock(
            self.scheduler,
            offset=float(rng.uniform(-0.2, 0.2)),
            drift=float(rng.uniform(-5e-5, 5e-5)),
            steady_offset=float(rng.uniform(10.0, 1e5)),
        )

    def _programs(self, *lines: SerialLine) -> dict[str, Program]:
        """Return the program of each node. ``lines``: from ``_lines`` or ``_busy_lines``."""
        arm_line, tapper_line = lines
        cell = self.cell

        def arm_connect(driver: ArmDriver, patience: float, _: Now) -> arm_jobs.Reading:
            driver.connect(timeout=patience)
            return arm_jobs.reading_of(driver)

        def arm() -> tuple[ArmLogic, CheckedArm]:
            arm_line.set_clock(self.clocks["scara_arm"].steady_offset)
            draw = np.random.default_rng([self.seed, 5, round(1e6 * self.scheduler.now)])
            options = ArmOptions(
                set_up=self.set_up,
                # In set-up mode, the arm must not home by itself.
                home_on_activate=self.set_up,
            )
            driver = make_arm_driver(
                cell.arm, arm_line, draw_number=lambda below: int(draw.integers(below))
            )
            return ArmLogic(options), CheckedArm(
                driver, self.oracle.check_move, lambda _, speed: self._check_speed(speed)
            )

        def tapper() -> tuple[TapperLogic, TapperDriver]:
            tapper_line.set_clock(self.clocks["tapper_trigger"].steady_offset)
            draw = np.random.default_rng([self.seed, 4, round(1e6 * self.scheduler.now)])
            settings = TapperSettings(mode=Mode.SETUP if self.set_up else Mode.RUN)
            driver = TapperDriver(
                tapper_line, settings, draw_number=lambda below: int(draw.integers(below))
            )

            options = TapperOptions(limits=limits, set_up=self.set_up)
            return TapperLogic(options), driver

        limits = PeerLimits(needs_camera=True)
        programs: dict[
            str, tuple[Callable[[], tuple[Logic, Any]], Callable[..., Any], tuple[SerialLine, ...]]
        ] = {
            "tap_planner": (lambda: (PlannerLogic(self.settings), None), self._connect_planner, ()),
            "scara_arm": (arm, arm_connect, (arm_line,)),
            "tapper_trigger": (
                tapper,
                lambda driver, patience, _: driver.connect(timeout=patience),
                (tapper_line,),
            ),
        }
        return {
            name: Program(make, connect, cell, SUBSCRIPTIONS[name], SERVES[name], own)
            for name, (make, connect, own) in programs.items()
        }

    # One run

    def run(self, goals: int) -> Report:
        """Start the cell, execute ``goals`` goals with their faults, and return the report."""
        try:
            self.bring_up()
            for number in range(goals):
                self._work_on_a_goal(number)
                for _ in range(int(self.rng.poisson(PROGRAM_TAPS))):
                    if not self.oracle.violations:
                        self._work_on_a_tap()
                if self.oracle.violations:
                    break
            if self._ends_quietly() and not self.oracle.violations:
                self._work_on_a_quiet_goal(goals)
        except HangError as hang:
            self.oracle.violate("hang", str(hang))
        except UnhandledDefectError as unhandled:
            self.oracle.violate("unhandled defect", str(unhandled))
        except Exception as error:  # one run must not end a campaign
            self._note(traceback.format_exc())
            self.oracle.violate(SIMULATOR_DEFECT, f"{type(error).__name__}: {error}")
        self.oracle.at_the_end()
        for process in self.processes.values():
            for defect in process.defects:
                self.oracle.violate("defect", defect)
            for service in process.unanswered():
                self.oracle.violate("no answer", f"{process.name} has not answered {service}")
            process.kill()
            self.report.by_node[f"freeze {process.name}"] += process.freezes
        for process in self._seconds:
            process.kill()
        self.report.releases = len(self.physical.releases)
        self.report.violations = self.oracle.violations
        self.report.cell_seconds = self.scheduler.now
        return self.report

    def bring_up(self) -> None:
        """Start every node and wait until the cell is ready for a goal."""
        self.start()
        self.recover()

    def start(self) -> None:
        """Start every node."""
        for process in self.processes.values():
            process.start()

    def draw_goal(self, rng: np.random.Generator) -> Pose:
        """Choose a random goal in the central area of the table."""
        x, y = rng.uniform((-0.1, -0.06), (0.1, 0.06))
        return Pose(float(x), float(y), float(rng.uniform(-0.6, 0.6)))

    def next_goal(self, number: int) -> Pose:
        """Choose the next goal at random. In 80 % of the cases, the goal is near the object, as in
        the paper's task."""
        rng = self.rng
        if self.asks and self._last_goal is not None and self._result is not None:
            # A person repeats a goal that has failed; its taps must be confirmed again.
            failed = self._result.error_code > 0
            if failed and self._request_rng.random() < SHARE_OF_REPEATED_GOALS:
                return self._last_goal
        true = self.physical.object_pose(self.scheduler.now)
        goal = self.draw_goal(rng)
        if rng.random() < 0.8:
            # Similar to the paper's task: a displacement and a rotation relative to the current
            # pose.
            turn, way = rng.uniform(-0.3, 0.3), rng.uniform(0.0, 0.04)
            angle = rng.uniform(-math.pi, math.pi)
            goal = Pose(
                float(np.clip(true.x + way * math.cos(angle), -0.15, 0.15)),
                float(np.clip(true.y + way * math.sin(angle), -0.1, 0.1)),
                float(true.theta + turn),
            )
        return goal

    def _ends_quietly(self) -> bool:
        """Return whether the run ends with a goal that nothing disturbs. Without the enabling
        switch, not every goal can be reached."""
        drawn = np.random.default_rng([self.seed, 30]).random() < SHARE_OF_QUIET_ENDS
        return self._faulty and not self.set_up and not self.asks and bool(drawn)

    def _work_on_a_quiet_goal(self, number: int) -> None:
        """Wait until no fault has an effect any more; then, the next goal must be reached."""
        for process in self.processes.values():
            process.planted = None
        self.scheduler.run(self.scheduler.now + QUIET_S)
        self.recover()
        self._faulty, self.tap_limit = False, 0
        self._work_on_a_goal(number)
        del self.report.outcomes[-1:]

    def _work_on_a_goal(self, number: int) -> None:
        faults = draw_faults(self._fault_rng, self, self._mix) if self._faulty else []
        self.report.faults.update(fault.kind for fault in faults)
        goal = self.next_goal(number)
        self._last_goal, self._goal_limit = goal, self.settings.goal_time_limit
        if not self._faulty:
            self._goal_limit = GOAL_TIME_LIMIT_S
        planner = self.processes["tap_planner"]
        starts = planner.starts
        began = self.scheduler.now
        self._result = None
        self._note(f"goal {number}: {goal}")
        if self.asks == ON_REQUEST:
            self.change_ask(True)
        self.send_goal(goal)
        self._waiting_faults = [fault for fault in faults if fault.moment is not None]
        self._moments.clear()
        for fault in faults:
            if fault.moment is None:
                self.scheduler.at(began + fault.time, partial(self._strike, fault), in_main=True)
        limit = began + self._goal_limit + GOAL_SLACK_S
        self.scheduler.run(limit, lambda: self._result is not None)
        if self._result is None:
            if planner.starts == starts:
                self.oracle.violate(
                    "goal without an end",
                    f"goal {number} has not ended {GOAL_SLACK_S:g} s after its time limit; the "
                    f"planner is in state {planner.logic.state.value}",
                )
            self._result = PositionObject.Result(error_code=-1, error_msg="its planner was lost")
        self._waiting_faults = []
        last = max((fault.time for fault in faults if fault.moment is None), default=0.0)
        self.scheduler.run(max(self.scheduler.now, began + last) + 0.5)
        result = self._result
        if result.error_code and not self._faulty and not self.set_up:
            self.oracle.violate(
                "failed without a fault", f"code {result.error_code}: {result.error_msg}"
            )
        self.report.outcomes.append(
            GoalOutcome(
                number,
                result.error_code,
                result.error_msg,
                self.scheduler.now - began,
                result.taps,
                tuple(fault.kind for fault in faults),
            )
        )
        self.recover()

    def _work_on_a_tap(self) -> None:
        """Let another program command one tap, without the planner."""
        self._release_before_a_tap()
        command = self._program_tap()
        if command is None:
            return
        faults = draw_faults(self._fault_rng, self, self._mix, at_the_shot=True)
        if not self._faulty:
            faults = []
        self.report.faults.update(fault.kind for fault in faults)
        self.report.program_taps += 1
        self._note(f"a program's tap {command.tap_id}")
        self._waiting_faults, self._result = list(faults), None
        self._moments.clear()
        if self._faulty and self._program_rng.random() < SHARE_OF_INVALID_TAPS:
            self._spoil(command)
        valid = command.tap_id not in self.oracle.invalid
        if valid and self._faulty and self.rng.random() < SHARE_OF_CONFLICTS:
            # A second program uses the same id for another tap.
            conflicting = copy_of(command)
            self._note("a second program's tap with the same id")
            self._publish_conflicting(command, conflicting)
        else:
            self.network.publish("program", "tap_command", command)

        def over() -> bool:
            reported = self._last("tapper_state")
            return (
                reported is not None and reported.tap_id == command.tap_id and reported.outcome != 0
            )

        self.scheduler.run(self.scheduler.now + PROGRAM_TIMEOUT_S, over)
        self.scheduler.run(self.scheduler.now + 0.5 * float(self.rng.random()))
        if not self._faulty or self._program_rng.random() >= SHARE_OF_FORGOTTEN_TAPS:
            withdrawal = TapCommand(request=TapCommand.WITHDRAW, tap_id=command.tap_id)
            withdrawal.header = command.header
            self.network.publish("program", "tap_command", withdrawal)
        self.scheduler.run(self.scheduler.now + 0.5)
        self._waiting_faults = []
        self.recover()

    def _release_before_a_tap(self) -> None:
        """In set-up mode, let the person sometimes release the enabling device before another
        program commands a tap and perhaps a trajectory."""
        if self._enabler is None or not self._faulty:
            return
        if self._mode_rng.random() >= SHARE_OF_UNENABLED_TAPS:
            return
        self._note("PERSON releases the enabling device")
        self.release_enabling((KEY, SWITCH), False, 3.0)
        self.scheduler.run(self.scheduler.now + 0.7)
        if self._mode_rng.random() < 0.5:
            point = JointTrajectoryPoint(positions=[0.5, 1.2, -0.02, 0.0])
            message = JointTrajectory(joint_names=list(self.joint_names), points=[point])
            self.network.publish("program", "joint_trajectory", message)
            self.scheduler.run(self.scheduler.now + 0.1)

    def _publish_conflicting(self, command: TapCommand, conflicting: TapCommand) -> None:
        """Publish two different commands with the same id: one is delivered only to the arm, the
        other only to the tapper."""
        sign = float(self.rng.choice((-1.0, 1.0)))
        kind, place = int(self._program_rng.integers(3)), conflicting.strike_pose.position
        if kind == 0:
            place.x += 0.02 * sign
        elif kind == 1:
            place.z += 0.005 * sign
        else:
            turned = from_message(conflicting.strike_pose) @ Pose(0.0, 0.0, 0.2 * sign)
            conflicting.strike_pose = to_message(turned, place.z)
        self.network.publish(STRANGER, "tap_command", conflicting, only="tapper_trigger")
        self.network.publish("program", "tap_command", command, only="scara_arm")

    def _program_tap(self) -> TapCommand | None:
        """Return a tap command of another program: a copy of the last tap command, moved to the
        observed pose of the object. Return None if no tap was commanded before, or if the object is
        not seen at rest."""
        last = max(self.oracle.commands, default=0)
        seen = self._state_for(last)
        if not last or seen is None or not (seen.visible and seen.at_rest):
            return None
        model = self.oracle.commands[last]
        there = from_message(seen.pose.pose) @ from_message(model.object_pose).inverse()
        now = self.clocks["tap_planner"].now().ros
        expiry, ahead, share = PROGRAM_EXPIRY_S, 0.0, float(self.rng.random())
        if self._faulty and share < SHARE_OF_SHORT_EXPIRIES:
            expiry = float(self.rng.uniform(*SHORT_EXPIRY_S))
        elif self._faulty and share > 1.0 - SHARE_OF_FUTURE_STAMPS:
            ahead = float(self.rng.uniform(*FUTURE_STAMP_S))
        command = TapCommand(
            request=TapCommand.TAP,
            tap_id=max(last + 1, self._spoilt_id + 1, now // NANOSECONDS),
            tapper=model.tapper,
            striker_speed=model.striker_speed,
            expiry=to_stamp(now + round((ahead + expiry) * NANOSECONDS)),
            object_pose=seen.pose.pose,
        )
        self._fit_to_object(command, model, there)
        command.header.frame_id = "table"
        command.header.stamp = to_stamp(now + round(ahead * NANOSECONDS))
        return command

    def _spoil(self, command: TapCommand) -> None:
        """Make one field of a command wrong."""
        self._spoilt_id = command.tap_id
        wrong = draw_wrong_field(self._program_rng)
        wrong.spoil(command, self.cell)
        self._note(f"wrong field of tap {command.tap_id}: {wrong.name}")
        self.oracle.on_invalid(command.tap_id, wrong.name, wrong.arm_refuses)

    def _state_for(self, tap_id: int) -> ObjectState | None:
        """Return the last published state of the object of a tap."""
        states: ObjectStates | None = self._last("object_states")
        return None if states is None else states.objects[0]

    def _fit_to_object(self, command: TapCommand, model: TapCommand, there: Pose) -> None:
        """Move the poses of a tap command with the object. ``there``: motion of the object since
        ``model`` was commanded."""
        command.strike_pose = to_message(
            there @ from_message(model.strike_pose), model.strike_pose.position.z
        )
        command.predicted_pose = to_message(there @ from_message(model.predicted_pose))

    def _strike(self, fault: Fault) -> None:
        self._note(f"FAULT {fault.description}")
        fault.strike(self)

    # Actions of people

    def pursued_goals(self) -> Mapping[str, Pose]:
        """Return the goals of the objects that the present goal moves, by name."""
        return self.oracle.pursued()

    def send_goal(self, goal: Pose, foreign: bool = False) -> None:
        """Send an action goal to the planner if the planner's process is running. ``foreign``:
        publish the goal of a second client instead."""
        message = PoseStamped(pose=to_message(goal))
        message.header.frame_id = "table"
        process = self.processes["tap_planner"]
        if foreign:
            self.oracle.on_goal_sent({self.cell.object.name: goal}, self.cell.tolerance)
            if self.confirmation is not None and self.asks == OF_GOAL:
                self.confirmation.asks = False
            self.network.publish("somebody_else", "goal_pose", message)
            return
        if not process.alive:
            self._result = PositionObject.Result(error_code=-1, error_msg="no planner")
            return
        self._token += 1
        token = self._goal_token = self._token
        action, goal_of_action, request = self._request(message)

        def ended(result: Any) -> None:
            if self._goal_token == token:
                self._goal_token = 0
            self._note(f"RESULT {result.error_code} {result.error_msg}")
            self._result = result
            self.oracle.check_result(request, result, self.tap_limit)

        process.request(action, goal_of_action, token, ended)

    def cancel_goal(self) -> None:
        """Cancel the action goal."""
        process, token = self.processes["tap_planner"], self._goal_token
        if not process.alive or not token:
            return
        process.request("cancel", None, token, lambda _: None, waits=False)
        starts = process.starts

        def check() -> None:
            if (process.starts, self._goal_token) == (starts, token):
                if self.scheduler.now < process.frozen_until + CANCEL_S:
                    self.scheduler.at(process.frozen_until + CANCEL_S, check)
                    return
                self.oracle.violate("cancel without effect", "the canceled goal has not ended")

        self.scheduler.after(CANCEL_S, check)

    def cancel_by_service(self) -> None:
        """Call the planner's service that ends the present goal, whoever sent it."""
        process = self.processes["tap_planner"]
        if not process.alive:
            return
        self._token += 1

        def answered(_: Trigger.Response) -> None:
            if self.oracle.is_pursuing():
                self.oracle.violate("cancel without effect", "the cancelled goal has not ended")

        process.request("~/cancel", Trigger.Request(), ("person", self._token), answered)

    def freeze(self, node: str, duration: float) -> None:
        """Freeze a process."""
        if node == "camera_pose":
            self.camera.frozen_until = self.scheduler.now + duration
            self.report.by_node["freeze camera_pose"] += 1
        else:
            self.processes[node].freeze(duration)
            if node == "scara_arm":
                self.oracle.arm_frozen_until = self.processes[node].frozen_until

    def kill(self, node: str, away: float) -> None:
        """Kill a process; it restarts after ``away`` s."""
        if node == "camera_pose":
            if not self.camera.alive:
                return
            self.report.by_node["kill camera_pose"] += 1
            self.camera.alive = False
            self.network.leave("camera_pose")
            self.scheduler.after(away, self.camera.restart)
            return
        process = self.processes[node]
        if not process.alive:
            return
        process.kill()
        if process.disk.stop is not None and self._program_rng.random() < SHARE_OF_DAMAGED_STOPS:
            self._note(f"the stop that {node} has stored is damaged")
            process.disk.stop = {}
        self.report.by_node[f"kill {node}"] += 1
        self._lost_process(node, crash=True)
        self.scheduler.after(away, lambda: self._start_again(node))

    def shut_down(self, node: str, away: float) -> None:
        """Shut a process down; it restarts after ``away`` s."""
        process = self.processes[node]
        if not process.alive:
            return
        process.shut_down()
        self.report.by_node[f"restart {node}"] += 1
        self._lost_process(node, crash=False)
        self.scheduler.after(away, lambda: self._start_again(node))

    def _lost_process(self, node: str, crash: bool) -> None:
        self._asked_to_clear.pop(node, None)  # the request ends with the process
        self.oracle.on_process_lost(node)
        if node == "scara_arm":
            self._taps_of_arm.clear()
        if node == "tap_planner":
            self._goal_token = 0
            if self.confirmation is not None:
                self.confirmation.asks = self.settings.ask
            if self._result is None:
                self._result = PositionObject.Result(
                    error_code=-1, error_msg="its planner was lost"
                )

    def _start_again(self, node: str) -> None:
        if not self.processes[node].alive:
            self.processes[node].start()

    def start_second(self, node: str, lasting: float) -> None:
        """Start a second instance of a node, as if by mistake, and kill this instance after
        ``lasting`` s.

        The second instance finds its device's port in use. Only the first instance answers service
        requests.
        """
        program = replace(self._programs(*self._busy_lines())[node], services=())
        second = Process(
            f"{node} (second)",
            program,
            self.scheduler,
            self.network,
            self.clocks[node],
            lambda low, high: float(self.rng.uniform(low, high)),
        )
        second.disk = self.processes[node].disk
        second.on_log = self._on_log
        self._seconds.append(second)
        second.start()
        self.scheduler.after(lasting, second.kill, in_main=True)

    def plant_exception(self, node: str, lines: int, function: str = "") -> None:
        """Let one of the next handlers or jobs of a node raise an exception, after ``lines`` lines
        of its code, which are counted from the next call of ``function`` if a name is given."""
        if self.processes[node].alive:
            self.processes[node].planted = PlantedException(lines, function)

    def _on_planted(self, node: str, place: str) -> None:
        self._note(f"EXCEPTION in {node} at {place}")
        self.report.by_node[f"exception {node}"] += 1
        if node == "scara_arm":
            # The arm has a fault now, until it is cleared and homed.
            self.oracle.forbid_motion()
            self._taps_of_arm.clear()

    def hide_object(self, duration: float) -> None:
        """Hide the object for ``duration`` s, as if a hand covered it."""
        self.oracle.hide()
        self._hidden_until = max(self._hidden_until, self.scheduler.now + duration)
        self.camera.faults.hidden_until = self._hidden_until
        self.scheduler.at(self._hidden_until, self._uncover)

    def _uncover(self) -> None:
        if self.scheduler.now >= self._hidden_until:
            self.oracle.uncover()

    def move_object(self, shift: Pose, duration: float = 0.0) -> None:
        """Move the object by hand, within the central area of the table; ``duration`` in s."""
        steps = 1 + round(duration / HAND_STEP_S)
        part = Pose(shift.x / steps, shift.y / steps, shift.theta / steps)
        for step in range(steps):
            self.scheduler.after(step * HAND_STEP_S, partial(self._shift_object, part))

    def _shift_object(self, shift: Pose) -> None:
        now = self.scheduler.now
        before = self.physical.object_pose(now)
        self.oracle.note_hand()
        self._place_by_hand(
            Pose(before.x + shift.x, before.y + shift.y, before.theta + shift.theta)
        )

    def _place_by_hand(self, pose: Pose) -> None:
        """Put the object at a pose. A position outside the central area of the table is moved to
        the edge of this area."""
        x, y = float(np.clip(pose.x, -0.2, 0.2)), float(np.clip(pose.y, -0.13, 0.13))
        self.physical.world.place(Pose(x, y, pose.theta))

    def press_emergency_stop(self, duration: float) -> None:
        """Hold the emergency stop of the panel for ``duration`` s."""
        self._pressed_until = max(self._pressed_until, self.scheduler.now + duration)
        self.network.publish("panel", "emergency_stop", Bool(data=True))
        self._hold_emergency_stop()
        self.scheduler.after(0.6 * duration, self._recover_too_early)
        self.scheduler.at(self._pressed_until, self._release_emergency_stop)

    def repeat_emergency_stop(self) -> None:
        """Let the panel repeat its level while its emergency stop is held."""
        if self.scheduler.now < self._pressed_until:
            self.network.publish("panel", "emergency_stop", Bool(data=True))

    def _release_emergency_stop(self) -> None:
        if self.scheduler.now >= self._pressed_until:
            self._end_hold()
            self.network.publish("panel", "emergency_stop", Bool(data=False))

    def _hold_emergency_stop(self) -> None:
        """Record that an emergency stop is pressed now."""
        self._pressed_at = self.scheduler.now
        self.held_since = min(self.held_since, self.scheduler.now)

    def _end_hold(self) -> None:
        """Record that an emergency stop is no longer asserted."""
        if self.scheduler.now >= self._pressed_until and not self.panels.held:
            self.held_since = math.inf

    def press_further_panel(self, press: PanelPress) -> None:
        """Press the emergency stop of a further panel, which may vanish while it is pressed."""
        self.panels.press(press)

    def _recover_too_early(self) -> None:
        """Call clear_fault and home while the emergency stop is held, to check that these calls
        have no effect. Do not call them while a further panel is pressed: if this panel cannot be
        queried, the second call would confirm that the cell is safe."""
        if self.panels.held:
            return
        for node in self.devices:
            self.call_service(node, "~/clear_fault")
        self.scheduler.after(1.0, self._home_too_early)

    def _home_too_early(self) -> None:
        if "scara_arm" in self.devices:
            self._request_homing()

    def interrupt_tapper_power(self) -> None:
        """Interrupt the power of the tapper's board, so that the board also loses its latched
        stop."""
        self.physical.tapper_board.power_cycle(self.scheduler.now)
        self.physical.tapper_line.schedule()

    def turn_arm_motors_off(self) -> None:
        """Switch the arm's motors off, as a sleep command does, so that the quill sinks.

        Marlin does not report motors that are off, so its board loses its power instead.
        """
        board = self.physical.arm_board
        if not isinstance(board, GrblEmulator):
            self.interrupt_arm_power()
            return
        board.enter_sleep(self.scheduler.now)
        self.physical.arm_line.schedule()
        self.oracle.lose_reference()

    def interrupt_arm_power(self) -> None:
        """Interrupt the power of the arm's board, so that the board loses the arm's position."""
        self.physical.arm_board.power_cycle(self.scheduler.now)
        self.physical.arm_line.schedule()
        self.oracle.lose_reference()

    def turn_tapper_motor_off(self, duration: float) -> None:
        """Switch the tapper's motor off for ``duration`` s, so that its steps have no effect."""

        def switch(on: bool) -> None:
            self.physical.tapper_board.set_motor_power(on, self.scheduler.now)
            self.physical.tapper_line.schedule()

        switch(False)
        self.scheduler.after(duration, lambda: switch(True))

    def press_stop_button(self, share: float) -> None:
        """Press the stop button that is wired to a board of the tapper; ``share``, from 0 to 1,
        selects the board."""
        boards = self._tapper_boards()
        board, line = boards[int(share * len(boards))]
        board.open_stop_loop(self.scheduler.now)
        line.schedule()

    def _tapper_boards(self) -> list[tuple[TapperEmulator, SerialLine]]:
        """Return the boards of the tapper with their lines."""
        return [(self.physical.tapper_board, self.physical.tapper_line)]

    def _note_stop(self, node: str) -> None:
        """Record that a process has received a stop. A process that is starting sends it to its
        device as soon as it has opened the port."""
        process = self.processes.get(node)
        sent = self.scheduler.now if process is None else process.started_at
        self.oracle.stopped_at.setdefault(node, max(self.scheduler.now, sent))

    def call_stop(self, node: str) -> None:
        """Call a node's service ``stop``."""
        process = self.processes[node]
        if process.alive:
            self.report.by_node[f"stop {node}"] += 1
        if process.alive and self.scheduler.now >= process.frozen_until:
            self._note_stop(node)
            self._asked_to_clear.pop(node, None)
            if node == "scara_arm":
                self.oracle.forbid_motion()
        self.call_service(node, "~/stop")

    def reset(self, node: str) -> None:
        """Clear the stop of a device's node and home the arm, as a person does who does not look
        whether a goal is under way."""
        if math.isfinite(self.held_since):
            return
        self.physical.press_clear_button()
        self.call_service(node, "~/clear_fault")
        if node == "scara_arm":
            self.oracle.motion_allowed = True
            self.scheduler.after(HOME_AFTER_S, self._request_homing)

    def _request_homing(self) -> None:
        """Request homing, as a person does who does not look whether an emergency stop is held.
        The request allows motion, unless the arm's process has received such a stop: a stop that
        is still on its way can have no effect yet."""
        if math.isinf(self.held_since) or "scara_arm" not in self.oracle.stopped_at:
            self.oracle.motion_allowed = True
        self.call_service("scara_arm", "~/home")

    def call_service(self, node: str, service: str) -> None:
        """Call a node's service that has no arguments, as a person does."""
        process = self.processes[node]
        if service == "~/home":
            self.oracle.ask_to_move()
        if service == "~/clear_fault" and process.alive:
            self._asked_to_clear[node] = self.scheduler.now
        if process.alive and process.logic is not None:
            self._token += 1
            token = ("person", self._token)
            answered = partial(self._on_response, node, service)
            process.request(service, Trigger.Request(), token, answered)

    def _on_requested(self, process: str, service: str, _: Any) -> None:
        if (process, service) == ("scara_arm", "~/stop"):
            self._taps_of_arm.clear()

    def _on_response(self, node: str, service: str, response: Trigger.Response) -> None:
        """Process the answer to a request of a person."""
        if service != "~/clear_fault":
            return
        if response.success:
            self._cleared(node)
        elif INSTRUCTION in response.message and self._faulty:
            self._interrupt_confirmation()

    def _cleared(self, node: str) -> None:
        """Record that a node has reported that it keeps no stop any more."""
        self.oracle.on_cleared(node, node in self._asked_to_clear)
        self._asked_to_clear.pop(node, None)

    def _interrupt_confirmation(self) -> None:
        """At a refusal that asks a person to confirm, sometimes press a further panel, or let the
        person do something else first."""
        rng, now = self._people_rng, self.scheduler.now
        if rng.random() < SHARE_OF_STOPS_AT_A_REFUSAL:
            later, held = float(rng.uniform(*STOP_AT_A_REFUSAL_S)), draw_duration(rng, 0.02, 0.5)
            press = partial(self.press_further_panel, PanelPress(held))
            self.scheduler.after(later, press, in_main=True)
        if rng.random() < SHARE_OF_ABSENCES and math.isinf(self._away_until):
            self._away_until = now + float(rng.uniform(*ABSENCE_S))

    def recover(self) -> None:
        """Recover the cell as a person would, until it is ready for a goal: inspect it, press the
        clear button, clear faults and home. A request that is refused is repeated, as the refusal
        instructs."""
        self._away_until = -math.inf
        until = self.scheduler.now + RECOVERY_S
        if self._enabler is not None:
            self._enabler.change_grip()
        arm_states, tapper_states = ArmState, TapperState
        while self.scheduler.now < until:
            self.scheduler.run(self.scheduler.now + 1.0)
            arm, tapper = self._last("arm_state"), self._last("tapper_state")
            if not all(process.alive for process in self.processes.values()) or arm is None:
                continue
            if tapper is None or self._waits():
                continue
            if arm.state == arm_states.IDLE and tapper.state == tapper_states.SAFE:
                if self._object_lost():
                    self._put_back()
                    continue
                return
            if tapper.state in (tapper_states.STOPPED, tapper_states.FAULT):
                self.physical.press_clear_button()
                self._ask_to_clear("tapper_trigger")
            locked = arm.state == arm_states.DISCONNECTED and arm.error_code == ErrorCode.ARM_ALARM
            if arm.state in (arm_states.STOPPED, arm_states.FAULT) or locked:
                self._ask_to_clear("scara_arm")
            elif arm.state == arm_states.NOT_HOMED:
                self._home()
        arm, tapper = self._last("arm_state"), self._last("tapper_state")
        self.oracle.violate("no way back", f"arm {arm}, tapper {tapper}")

    def _waits(self) -> bool:
        """Return whether the person who recovers the cell waits: until every emergency stop is
        released, or because the person does something else."""
        return math.isfinite(self.held_since) or self.scheduler.now < self._away_until

    def _home(self) -> None:
        """Home the arm. In set-up mode, the person sometimes releases the enabling device first."""
        if self._enabler is not None:
            self._enabler.change_grip()
            if self._faulty and self._mode_rng.random() < SHARE_OF_UNENABLED_HOMING:
                self._enabler.release((KEY, SWITCH), silent=False, away=1.0)
                self.scheduler.run(self.scheduler.now + 0.7)
        self.oracle.motion_allowed = True
        self.call_service("scara_arm", "~/home")

    def _ask_to_clear(self, node: str) -> None:
        """Ask a node to clear its stop or fault. Sometimes somebody stops the node again before it
        has cleared."""
        self.call_service(node, "~/clear_fault")
        if self._faulty and self._people_rng.random() < SHARE_OF_REPEATED_REQUESTS:
            later = float(self._people_rng.uniform(*REPEATED_AFTER_S))
            self.scheduler.after(later, partial(self.call_service, node, "~/clear_fault"))
        if self._faulty and self.rng.random() < SHARE_OF_STOPS_AT_A_CLEAR:
            within = float(self.rng.uniform(0.0, STOP_AT_A_CLEAR_S))
            self.scheduler.after(within, partial(self.call_stop, node), in_main=True)

    def _object_lost(self) -> bool:
        pose = self.physical.object_pose(self.scheduler.now)
        return abs(pose.x) > 0.2 or abs(pose.y) > 0.13

    # Messages

    def _last(self, topic: str) -> Any:
        kept = self.network.history.get(topic)
        return kept[-1] if kept else None

    def _observe(self, time: float) -> Pose | None:
        return self.physical.view(time) if self.arm_covers else self.physical.object_pose(time)

    def _on_publish(self, node: str, topic: str, message: Any) -> None:
        if self._tracing and topic not in ("markers", "joint_states"):
            text = f"{node} -> {topic} {_short(message)}"
            if self._last_reports.get((node, topic)) != text:
                self._last_reports[node, topic] = text
                self._note(text)
        self.oracle.on_publish(node, topic, message)
        if self.confirmation is not None and node == "tap_planner":
            if topic == "plan_state":
                self.confirmation.on_plan_state(message)
            elif topic == "tap_command" and message.request == TapCommand.TAP:
                self.confirmation.on_tap(message)
        if topic == "~/stop_state" and not message.stopped:
            self._cleared(node)
        of_enabling = topic == "arm_state" and message.error_code == ErrorCode.ENABLING_RELEASED
        if of_enabling and node == "scara_arm" and message.state == ArmState.STOPPED:
            # This stop, too, lasts until a person clears it.
            self._note_stop(node)
        states = ("arm_state", "tapper_state", "plan_state")
        if topic in states and self._states.get(topic) != message.state:
            self._states[topic] = message.state
            self._reached(moment_name(topic, message.state))

    def _reached(self, name: str) -> None:
        """Count this moment, and inject the faults that wait for it."""
        self._moments[name] += 1
        for fault in list(self._waiting_faults):
            if fault.moment == Moment(name, self._moments[name]):
                self._waiting_faults.remove(fault)
                self.scheduler.after(fault.time, partial(self._strike, fault), in_main=True)

    def _on_call(self, service: str, request: Any) -> None:
        if service == "hold_still":
            self._reached(ARM_ASKED)
        if service == "confirm_tap" and self.confirmation is not None:
            self.confirmation.on_call(request)

    def _on_answer(self, node: str, service: str, request: Any, response: Any) -> None:
        if service == "hold_still" and node == "scara_arm":
            self.oracle.on_answer(node, request, response)
            self._reached(ARM_PROMISED)
        elif service == "confirm_tap" and self.confirmation is not None:
            self.confirmation.on_answer(request, response)

    def _on_asked(self, process: str, job: str, answer: Any) -> None:
        if job == "fire":
            self._reached(CHECKED)

    def _check_speed(self, speed: float) -> None:
        if self.enabling is not None:
            self.enabling.check_speed(speed)

    def _after_event(self) -> None:
        before = len(self.physical.releases)
        self.oracle.after_event()
        if self.enabling is not None:
            for release in self.physical.releases[self._checked_releases : before]:
                self.enabling.check_release(release)
            self._checked_releases = before
            if "scara_arm" in self.processes:
                self.enabling.check_motion()

    def _on_handled(self, process: str, topic: str, message: Any) -> None:
        if topic == "enabling" and self.enabling is not None:
            self.enabling.on_key(process, message.data)
        if process == "scara_arm" and self._may_move_arm(topic, message):
            self.oracle.ask_to_move()
        self.oracle.on_delivered(process, topic, message, self.processes[process].active)
        if topic == "emergency_stop" and message.data:
            self._note_stop(process)
            # A frozen process receives the stop late, and handles a later request after it.
            if self._asked_to_clear.get(process, -math.inf) < self._pressed_at:
                self._asked_to_clear.pop(process, None)
            if process == "scara_arm":
                self.oracle.forbid_motion()
                self._taps_of_arm.clear()

    def _may_move_arm(self, topic: str, message: Any) -> bool:
        """Return whether a message is allowed to make the arm move. A withdrawal must not move the
        arm unless the arm has received its tap since the last stop."""
        if topic == "tap_command":
            if message.request == TapCommand.TAP:
                self._taps_of_arm.add(message.tap_id)
            of_a_tap = message.request != TapCommand.WITHDRAW and message.tap_id != 0
            return of_a_tap or message.tap_id in self._taps_of_arm
        return topic == "joint_trajectory"

    def _on_lifecycle(self, process: str, active: bool) -> None:
        self.oracle.on_lifecycle(process, active)

    def _on_log(self, process: str, sentence: str) -> None:
        self._note(f"{process}: {sentence}")

    def _note(self, entry: str) -> None:
        if self._tracing:
            self.report.trace.append(f"{self.scheduler.now:12.6f} {entry}")


def _short(message: Any) -> str:
    """Return a short description of a message for the trace."""
    if isinstance(message, ObjectState):
        name = f"{message.object_id} " if message.object_id else ""
        return f"{name}visible={message.visible} rest={message.at_rest}"
    if isinstance(message, ObjectStates):
        return "; ".join(map(_short, message.objects))
    if isinstance(message, PlanState):
        return f"state={message.state} taps={message.taps} {message.error_code} {message.error_msg}"
    if isinstance(message, ArmState):
        return (
            f"state={message.state} tap={message.tap_id} {message.error_code} {message.error_msg}"
        )
    if isinstance(message, TapperState):
        return (
            f"state={message.state} tap={message.tap_id} outcome={message.outcome}"
            f" {message.error_code} {message.error_msg}"
        )
    if isinstance(message, TapCommand):
        return f"request={message.request} tap={message.tap_id}"
    return repr(message)[:200]
