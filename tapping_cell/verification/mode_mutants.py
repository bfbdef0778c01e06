"""Defects of set-up mode and of the confirmation of taps that their invariants must detect; see
``mutants``."""

from __future__ import annotations

from tapping_cell.verification.mutants import Mutant

ARM = "tapping_cell.logic.arm"
ENABLING = "tapping_cell.logic.enabling"
PLANNER = "tapping_cell.logic.planner"
CONFIRMATION = "tapping_cell.logic.confirmation"
BOARD = "tapping_cell.simulation.tapper_emulator"
TAPPER = "tapping_cell.logic.tapper"
RELEASED = ("enabling device released",)

MODE_MUTANTS: tuple[Mutant, ...] = (
    Mutant(
        "moves on after the enabling device was released",
        ARM,
        "        if self._enabled(now) or self.state not in AT_WORK:\n            return\n",
        "        return\n",
        kinds=RELEASED,
        set_up=True,
    ),
    Mutant(
        "places the arm without the enabling device",
        ARM,
        "        if not self._enabled(now):\n            return enabling.RELEASED\n",
        "",
        kinds=RELEASED,
        set_up=True,
    ),
    Mutant(
        "follows a trajectory without the enabling device",
        ARM,
        "        if not self._enabled(now):\n            code, reason = enabling.RELEASED\n",
        "        if False:\n            code, reason = enabling.RELEASED\n",
        kinds=(*RELEASED, "fast trajectory"),
        set_up=True,
    ),
    Mutant(
        "homes without the enabling device",
        ARM,
        "elif not self._enabled(now):",
        "elif False:",
        kinds=RELEASED,
        set_up=True,
    ),
    Mutant(
        "moves at the ordinary speed in set-up mode",
        ARM,
        "travel_speed=SET_UP_SPEED * motion.travel_speed",
        "travel_speed=motion.travel_speed",
        kinds=("cancel",),
        set_up=True,
    ),
    Mutant(
        "follows a trajectory at the ordinary speed in set-up mode",
        ARM,
        "scale = SET_UP_SPEED if self._options.set_up else 1.0",
        "scale = 1.0",
        kinds=("fast trajectory",),
        set_up=True,
    ),
    # A cell with an arm stops the arm as well, and this ends the tap.
    Mutant(
        "fires without the enabling device",
        TAPPER,
        "        if self._set_up and not self._enabling.held(now):\n"
        "            return enabling.RELEASED\n        if now.ros > tap.expiry:",
        "        if now.ros > tap.expiry:",
        also=Mutant(
            "continues a tap without the enabling device",
            TAPPER,
            "if self._set_up and self.state in SERVING and not self._enabling.held(now):",
            "if False:",
        ),
        kinds=RELEASED,
        fixed=True,
        set_up=True,
    ),
    Mutant(
        "counts a report of the switch from its arrival",
        ENABLING,
        "max(self._switch_at, self._tapper_clock.to_steady(stamp, now))",
        "now.steady",
        kinds=("enabling device released", "slow topic", "replay"),
        set_up=True,
    ),
    Mutant(
        "waits too long for the next message of the enabling device",
        ENABLING,
        "HEARTBEAT_S = 0.35",
        "HEARTBEAT_S = 2.5",
        kinds=RELEASED,
        set_up=True,
    ),
    Mutant(
        "takes every message of the key as held",
        ENABLING,
        "self._key_at = now.steady if held else -math.inf",
        "self._key_at = now.steady",
        kinds=RELEASED,
        set_up=True,
    ),
    Mutant(
        "takes every report of the switch as held",
        ENABLING,
        "self._switch_at = now.steady if held else -math.inf",
        "self._switch_at = now.steady",
        kinds=RELEASED,
        set_up=True,
    ),
    Mutant(
        "sets the board to run mode",
        "tapping_cell.hardware.tapper",
        "return self.set_mode(self._mode)",
        "return self.set_mode(Mode.RUN)",
        kinds=RELEASED,
        set_up=True,
    ),
    Mutant(
        "stays charged after the switch was released",
        BOARD,
        'if self._state in ("CHARGING", "CHARGED") and self._too_much_for_setup(self._energy_uj):',
        "if False:",
        kinds=RELEASED,
        set_up=True,
    ),
    Mutant(
        "accepts a confirmation of another tap",
        PLANNER,
        "if shot is None or task is None or shot.tap_id != asked.tap_id:",
        "if shot is None or task is None:",
        kinds=("cancel",),
        ask=True,
    ),
    Mutant(
        "makes a tap that was rejected",
        PLANNER,
        "        if not asked.confirm:\n",
        "        if False:\n",
        kinds=("cancel",),
        ask=True,
    ),
    Mutant(
        "keeps a rejected tap proposed",
        PLANNER,
        "        shot, self._proposed = self._proposed, None\n        assert shot is not None\n"
        "        self._log",
        "        shot = self._proposed\n        assert shot is not None\n        self._log",
        kinds=("cancel",),
        ask=True,
    ),
    Mutant(
        "uses a confirmation that is out of date",
        CONFIRMATION,
        "if now - self.at > HOLDS_S:",
        "if False:",
        kinds=("camera away",),
        ask=True,
    ),
    Mutant(
        "uses a confirmation for a different tap",
        CONFIRMATION,
        "if _apart(one, other, distance, angle):",
        "if False:",
        kinds=("camera away", "object moved", "freeze at a shot", "camera"),
        ask=True,
    ),
    Mutant(
        "keeps a confirmation of a tap that was refused",
        CONFIRMATION,
        "        if self.withdrawn:\n",
        "        if False:\n",
        kinds=("guard", "foreign outcome", "emergency stop"),
        ask=True,
    ),
    Mutant(
        "keeps a confirmation of a tap whose refusal came late",
        PLANNER,
        "        if shot.outcome == TapperState.NOT_FIRED and tapper.error_code",
        "        if self.state in TAPPING and tapper.error_code",
        kinds=("foreign outcome", "slow topic", "received by one"),
        ask=True,
    ),
    Mutant(
        "keeps a proposed tap although the object was moved",
        PLANNER,
        "        elif self._disturbed(shot, now):\n"
        '            self._drop_proposal("an object was moved", now)\n',
        "",
        kinds=("object moved", "object turned"),
        ask=True,
    ),
    Mutant(
        "ignores a change of ask",
        PLANNER,
        "        self._ask, self._ask_resumed = ask, False\n",
        "",
        kinds=("cancel",),
        ask=True,
    ),
    Mutant(
        "ignores that a goal asks before every tap",
        PLANNER,
        "return self._ask or (task is not None and (task.ask or self._ask_resumed))",
        "return self._ask or (task is not None and self._ask_resumed)",
        kinds=("cancel",),
        ask=True,
    ),
    Mutant(
        "a resumed goal no longer asks",
        PLANNER,
        '"ask": task.ask,',
        '"ask": False,',
        kinds=("kill",),
        ask=True,
    ),
    Mutant(
        "asks no longer after a crash",
        PLANNER,
        '"ask_always": self._ask or self._ask_resumed,',
        '"ask_always": False,',
        kinds=("kill",),
        ask=True,
    ),
    Mutant(
        "makes a proposed tap that nobody has confirmed",
        PLANNER,
        "        elif self._late(now):\n            self._fail(\n"
        "                ErrorCode.TAP_NOT_CONFIRMED,",
        "        elif self._late(now):\n            self._command(shot, now)\n"
        "        elif self._late(now):\n            self._fail(\n"
        "                ErrorCode.TAP_NOT_CONFIRMED,",
        kinds=("cancel",),
        ask=True,
    ),
)
