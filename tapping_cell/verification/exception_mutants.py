"""Mutants of what a node does after an exception in its own code."""

from __future__ import annotations

from tapping_cell.verification.mutants import Mutant

DEVICE = "tapping_cell.logic.device"
PLANNER = "tapping_cell.logic.planner"
KINDS = ("exception",)
IN_PLANNER = ("exception in the planner",)

EXCEPTION_MUTANTS: tuple[Mutant, ...] = (
    Mutant(
        "does not stop the device after an internal error",
        DEVICE,
        "        self._effects.append(StopWire())\n        self._latch_lost_stop(lost)\n",
        "        self._latch_lost_stop(lost)\n",
        kinds=KINDS,
    ),
    Mutant(
        "reports no fault after an internal error",
        DEVICE,
        "        elif self._configured:\n            self._fail(now)\n",
        "",
        kinds=KINDS,
    ),
    Mutant(
        "does not complete a stop that its internal error interrupted",
        DEVICE,
        "        if self._stops.stopped and (self.state is not self.stopped_state or unstarted):\n",
        "        if False:\n",
        kinds=KINDS,
    ),
    Mutant(
        "loses a stop if its handler raises",
        DEVICE,
        "        self._latch_lost_stop(lost)\n",
        "",
        kinds=(*KINDS, *KINDS, "kill"),
    ),
    Mutant(
        "cannot handle an internal error while it begins to clear a stop of the arm",
        "tapping_cell.logic.arm",
        "        if self.state is not S.STOPPED:\n            self._fail_to(S.FAULT)\n",
        "        if not self._stops.stopped:\n            self._fail_to(S.FAULT)\n",
        kinds=(*KINDS, *KINDS, "stop service"),
    ),
    Mutant(
        "does not store the stops after an internal error",
        DEVICE,
        "        self._keep_stops(now)  # the handler may have latched or reset a stop\n",
        "",
        kinds=(*KINDS, *KINDS, "kill"),
    ),
    Mutant(
        "loses the outcome of a shot if the handler of its end raises",
        DEVICE,
        "            self._overtaken(lost, now)\n        elif",
        "            pass\n        elif",
        kinds=KINDS,
    ),
    Mutant(
        "waits for the outcome of a shot that an internal error prevented",
        DEVICE,
        "        for job in unstarted:\n",
        "        for job in ():\n",
        kinds=KINDS,
    ),
    Mutant(
        "reports no outcome of a tap that an internal error ended before its shot",
        "tapping_cell.logic.tapper",
        "        if self._awaits_outcome() and self._fire_job is None:\n",
        "        if False:\n",
        kinds=KINDS,
    ),
    Mutant(
        "ignores an internal error while it reads the device",
        DEVICE,
        "            if (self._job is None or is_defect) and not self._stops.stopped:\n",
        "            if self._job is None and not self._stops.stopped:\n",
        kinds=KINDS,
    ),
    Mutant(
        "does not answer a request whose handler raised",
        PLANNER,
        "            if lost.token not in answered:\n",
        "            if False:\n",
        kinds=IN_PLANNER,
    ),
    Mutant(
        "answers a request twice if its handler raised after the answer",
        DEVICE,
        "                unanswered.pop(effect.token, None)\n",
        "                pass\n",
        kinds=KINDS,
    ),
    Mutant(
        "forgets a request to clear after an internal error",
        DEVICE,
        '        unanswered = dict.fromkeys(self._resets, "~/clear_fault")\n',
        "        unanswered: dict[Token, str] = {}\n",
        kinds=(*KINDS, "stop service"),
    ),
    Mutant(
        "does not withdraw the tap after an internal error",
        PLANNER,
        "        self._end_tap(now)\n        sentence = _internal_error(error)\n",
        "        sentence = _internal_error(error)\n",
        kinds=IN_PLANNER,
    ),
    Mutant(
        "takes a withdrawal for published before it is",
        PLANNER,
        "        self._publish_withdrawal(tap_id, now)\n"
        "        self._withdrawn_tap_id, self._withdrawn_at = tap_id, now.steady\n",
        "        self._withdrawn_tap_id, self._withdrawn_at = tap_id, now.steady\n"
        "        self._publish_withdrawal(tap_id, now)\n",
        kinds=IN_PLANNER,
    ),
    Mutant(
        "continues its goal after an internal error",
        PLANNER,
        "        if self._task is not None:\n"
        "            self._finish(S.FAILED, ErrorCode.INTERNAL, sentence, now)\n"
        "        else:\n",
        "        if self._task is None:\n",
        kinds=IN_PLANNER,
    ),
    Mutant(
        "resumes a goal that an internal error had ended",
        PLANNER,
        "            self._resumed = None\n            self._effects.append(KeepGoal(None))\n",
        "",
        kinds=IN_PLANNER,
    ),
    Mutant(
        "commands the tap that a handler prepared before its internal error",
        PLANNER,
        "        self._effects = [effect for effect in self._effects if not _begins(effect)]\n",
        "",
        kinds=IN_PLANNER,
    ),
    Mutant(
        "counts a tap whose command was not published",
        PLANNER,
        "            self._shot = None  # its command was not published\n",
        "            pass\n",
        kinds=IN_PLANNER,
    ),
    Mutant(
        "does not count a tap if its evaluation raises",
        PLANNER,
        "        shot = self._shot\n"
        "        if shot is not None and self._may_have_been_fired(shot):\n",
        "        shot, self._shot = self._shot, None\n"
        "        if shot is not None and self._may_have_been_fired(shot):\n",
        kinds=IN_PLANNER,
    ),
    Mutant(
        "counts the last tap twice if the end of its goal raises",
        "tapping_cell.logic.task",
        "(TapperState.FIRED, TapperState.UNKNOWN) and not recorded:\n",
        "(TapperState.FIRED, TapperState.UNKNOWN):\n",
        kinds=IN_PLANNER,
    ),
)
