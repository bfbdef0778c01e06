"""Defects in the handling of commands, trajectories, goals, faults and stops that the invariants
must detect; see ``mutants``."""

from __future__ import annotations

from tapping_cell.verification.mutants import Mutant

ARM = "tapping_cell.logic.arm"
ARM_JOBS = "tapping_cell.logic.arm_jobs"
COMMANDS = "tapping_cell.logic.tap_commands"
DEVICE = "tapping_cell.logic.device"
GOALS = "tapping_cell.logic.goal_validation"
HANDLING = "tapping_cell.logic.goal_handling"
MONITOR = "tapping_cell.logic.cell_monitor"
PEERS = "tapping_cell.logic.tapper_peers"
PLANNER = "tapping_cell.logic.planner"
SETTINGS = "tapping_cell.logic.planner_settings"
STOPS = "tapping_cell.logic.stops"
TAPPER = "tapping_cell.logic.tapper"
TRAJECTORIES = ("foreign trajectory", "invalid trajectory")
WRONG_GOAL = ("invalid goal",)
CAMERA_LOST = ("camera", "kill")

COMMAND_MUTANTS: tuple[Mutant, ...] = (
    # Charging
    Mutant(
        "charges while the arm travels",
        PEERS,
        "        return _above(arm, strike)\n\n    def _check_arm",
        "        return True\n\n    def _check_arm",
    ),
    Mutant(
        "charges without asking where the arm is",
        PEERS,
        "if not self._lowers(tap_id, strike, now):",
        "if False:",
    ),
    Mutant(
        "charges although the arm is silent",
        PEERS,
        "if now.steady - self._arm_received > self._limits.arm_freshness:",
        "if False:",
        kinds=("freeze at a shot", "kill"),
    ),
    # Invalid commands
    Mutant(
        "accepts a command in any frame",
        COMMANDS,
        'if command.header.frame_id != "table":',
        "if False:",
    ),
    Mutant(
        "accepts an unknown request",
        COMMANDS,
        "if command.request not in (TapCommand.TAP, TapCommand.CLEAR_VIEW):",
        "if False:",
    ),
    Mutant(
        "accepts a quaternion of any length",
        COMMANDS,
        "if abs(quaternion_norm(command.strike_pose) - 1) > 0.01:",
        "if False:",
    ),
    Mutant(
        "accepts a number that is not finite",
        COMMANDS,
        "if not (is_finite(command.strike_pose) and math.isfinite(command.striker_speed)):",
        "if False:",
    ),
    Mutant(
        "accepts an id of any size",
        COMMANDS,
        "if not 0 < command.tap_id <= largest:",
        "if not 0 < command.tap_id:",
    ),
    Mutant("accepts an expiry hours ahead", COMMANDS, "if left > LONGEST_EXPIRY_S:", "if False:"),
    Mutant(
        "charges another tapper than the named one",
        COMMANDS,
        "return name if name in tappers else None",
        "return name if name in tappers else tappers[0]",
    ),
    Mutant(
        "charges the first of several tappers if none is named",
        COMMANDS,
        'if name == "" and len(tappers) == 1:',
        'if name == "":',
        fixed=True,
    ),
    Mutant(
        "takes a request to clear the view as a tap",
        TAPPER,
        "if command.request == TapCommand.CLEAR_VIEW:",
        "if False:",
    ),
    Mutant(
        "accepts a striker speed outside the tapper's range",
        TAPPER,
        "if math.isfinite(speed) and not curve.slowest <= speed <= curve.fastest:",
        "if False:",
    ),
    # End of a tap
    Mutant(
        "goes on with its tap after it was deactivated",
        TAPPER,
        'self._give_up((ErrorCode.NOT_ACTIVE, "the node was deactivated"))',
        "pass",
        kinds=("deactivate",),
    ),
    Mutant(
        "accepts a tap while it is inactive",
        TAPPER,
        "        if not self._active or not self._configured:\n"
        '            return ErrorCode.NOT_ACTIVE, "the node is not active; activate it first"\n'
        "        if self.state is not S.SAFE:",
        "        if self.state is not S.SAFE:",
        kinds=("deactivate",),
    ),
    Mutant(
        "waits for ever after the expiry of its tap",
        TAPPER,
        "if self.state is S.WAITING and tap is not None and now.ros > tap.expiry:",
        "if False:",
    ),
    Mutant(
        "the withdrawal of any tap ends the tapper's tap",
        TAPPER,
        "if tap is not None and command.tap_id == tap.tap_id:",
        "if tap is not None:",
        kinds=("foreign command",),
    ),
    Mutant(
        "the withdrawal of any tap ends the arm's tap",
        ARM,
        "ours = command.tap_id != 0 and command.tap_id == self._tap_id",
        "ours = True",
        kinds=("foreign command",),
    ),
    # The shot
    Mutant(
        "fires at any height",
        PEERS,
        "if not abs(height - self._height) <= HEIGHT_M:",
        "if False:",
    ),
    Mutant(
        "fires at any angle of the tip",
        PEERS,
        "return tip.distance_to(strike) <= ABOVE_M and abs(tip.rotation_to(strike)) <= ABOVE_RAD",
        "return tip.distance_to(strike) <= ABOVE_M",
    ),
    Mutant(
        "fires without any image since its start",
        PEERS,
        "if self._limits.needs_camera and self._picture_at is None:",
        "if False:",
        kinds=("kill",),
    ),
    Mutant(
        "takes images of an uncalibrated camera as usable",
        PEERS,
        "        ErrorCode.CAMERA_NOT_CALIBRATED,\n",
        "",
        kinds=("camera",),
    ),
    Mutant(
        "counts the age of an image from its arrival",
        PEERS,
        'seen_at = self._clocks["camera"].to_steady(state.header.stamp, now)',
        "seen_at = now.steady",
        kinds=("camera",),
    ),
    Mutant(
        "fires although all messages of a node are late",
        "tapping_cell.logic.peer_clock",
        "if abs(skew) > SKEW_LIMIT_S:",
        "if -skew > SKEW_LIMIT_S:",
        kinds=("clock step", "slow topic"),
    ),
    Mutant(
        "asks the arm to stand still without end",
        TAPPER,
        "elif self._attempts < HOLD_ATTEMPTS:",
        "elif True:",
        kinds=("slow answer",),
    ),
    # Stops
    Mutant(
        "does not tell when the device was stopped",
        DEVICE,
        "            self._last_stop = to_stamp(now.ros)",
        "            pass",
        kinds=("stop service", "emergency stop"),
    ),
    Mutant(
        "does not see the stop button of its board",
        TAPPER,
        "        if reply.stop_latched:\n            self._stop_tap()",
        "        if False:\n            self._stop_tap()",
        kinds=("stop at the cell",),
    ),
    Mutant(
        "reports a stop of its board as a fault",
        TAPPER,
        "self._fail_to(S.STOPPED if fault.reason in STOPPED_BOARD else S.FAULT)",
        "self._fail_to(S.FAULT)",
        kinds=("stop at the cell",),
    ),
    Mutant(
        "does not stop a board that has lost its power again",
        DEVICE,
        "again = self.repeats_stop and now.steady - self._stop_sent_at >= STOP_AGAIN_S",
        "again = False",
        kinds=("stop without power",),
    ),
    Mutant(
        "forgets a stop whose file is damaged",
        STOPS,
        "names = names or [RESTART]",
        "names = names or []",
        kinds=("emergency stop", "kill"),
    ),
    # The arm
    Mutant(
        "places the arm twice for a tap",
        ARM,
        "self._tap_id = self._last_tap_id = self._last_id = command.tap_id",
        "self._tap_id = self._last_tap_id = command.tap_id",
        kinds=("repeated command", "replay"),
    ),
    Mutant(
        "takes a tap whose withdrawal arrived before its command",
        TAPPER,
        "if command.tap_id in self._withdrawn:",
        "if False:",
        kinds=("repeated command", "kill"),
    ),
    Mutant(
        "homes by itself in set-up mode",
        ARM,
        "alone = self._options.home_on_activate and not self._options.set_up",
        "alone = self._options.home_on_activate",
        set_up=True,
    ),
    Mutant(
        "ignores the order of the joints of a trajectory",
        ARM,
        "order = [list(message.joint_names).index(name) for name in names]",
        "order = list(range(len(names)))",
        kinds=TRAJECTORIES,
    ),
    Mutant(
        "follows a trajectory at full speed",
        ARM_JOBS,
        "speed = speed_for(driver.geometry, here, target, at - before) if at > before else 1.0",
        "speed = 1.0",
        kinds=TRAJECTORIES,
    ),
    Mutant(
        "follows a trajectory beyond the limits of the joints",
        ARM,
        "                check_limits(self._geometry, target)\n",
        "                pass\n",
        kinds=TRAJECTORIES,
    ),
    Mutant(
        "follows a trajectory whose times fall",
        ARM,
        "if at < 0 or (targets and at <= before):",
        "if False:",
        kinds=TRAJECTORIES,
    ),
    Mutant(
        "stamps its state with the time of publication",
        ARM,
        "message.header.stamp = self._read_stamp if reading is not None else to_stamp(now.ros)",
        "message.header.stamp = to_stamp(now.ros)",
    ),
    Mutant(
        "does not settle at the strike pose",
        ARM_JOBS,
        "reading = driver.settle(path[-1].joints if path else None)\n    return MotionEnd(not",
        "reading = driver.read()\n    return MotionEnd(not",
    ),
    Mutant(
        "lowers the striker for an expired tap",
        ARM_JOBS,
        "if not _move_along(context, path, expiry):",
        "if not _move_along(context, path):",
    ),
    Mutant(
        "begins to move for an expired tap",
        ARM,
        "        if tap_commands.expired(command, now):\n"
        "            return ErrorCode.ARM_COMMAND_EXPIRED",
        "        if False:\n            return ErrorCode.ARM_COMMAND_EXPIRED",
        kinds=("slow topic", "freeze", "clock step", "repeated command"),
    ),
    Mutant(
        "promises to stand still for any time",
        ARM,
        "if not 0 < request.duration <= self._longest_hold:",
        "if not 0 < request.duration:",
        kinds=("foreign hold",),
    ),
    # Goals
    Mutant(
        "does not end its goal at a fault of arm or tapper",
        PLANNER,
        "            stop = self._monitor.fault() or stop\n",
        "",
    ),
    Mutant(
        "does not end its goal when it is deactivated",
        PLANNER,
        "                self._fail(ErrorCode.NOT_ACTIVE, sentence, now)\n",
        "                pass\n",
        kinds=("deactivate",),
    ),
    Mutant(
        "executes an outdated goal",
        GOALS,
        "if stamp > 0 and not -FARTHEST_AHEAD_S <= age <= OLDEST_S:",
        "if False:",
        kinds=WRONG_GOAL,
    ),
    Mutant(
        "executes a tilted goal",
        GOALS,
        "if tilted > LARGEST_TILT or abs(height) > LARGEST_HEIGHT:",
        "if False:",
        kinds=WRONG_GOAL,
    ),
    Mutant(
        "executes a goal whose quaternion is not normalised",
        GOALS,
        "if abs(norm - 1) > NORM_SLACK:",
        "if False:",
        kinds=WRONG_GOAL,
    ),
    Mutant(
        "does not withdraw its tap when the object was moved",
        PLANNER,
        "        if self._monitor.seen_away_from(shot.before, *limits):\n            return True\n",
        "",
        kinds=("object moved", "object turned"),
    ),
    Mutant(
        "ignores the requested tolerance",
        GOALS,
        "return position or default[0], angle or default[1]",
        "return default",
    ),
    Mutant(
        "ignores the requested time limit",
        HANDLING,
        "expires = now.steady + (request.time_limit or self._time_limit)",
        "expires = now.steady + self._time_limit",
    ),
    Mutant(
        "waits ten times as long for the arm",
        SETTINGS,
        '"maximum time to move the striker to its strike pose", "s", 1.0, 600.0, default=20.0',
        '"maximum time to move the striker to its strike pose", "s", 1.0, 600.0, default=200.0',
        kinds=("kill", "freeze", "unreported trajectory"),
    ),
    Mutant(
        "keeps a confirmation beyond the end of its goal",
        PLANNER,
        "        self._proposed = self._confirmed = None\n",
        "        self._proposed = None\n",
        kinds=("cancel", "cancel by service"),
        ask=True,
    ),
)
