"""Single faults planted in the shipping logic: each must be caught, or its guard does nothing.

A mutant is a small replacement in the source of one module of ``logic`` or ``hardware``, applied
while the module is imported. The files on disk stay as they are.
"""

from __future__ import annotations

import importlib.abc
import importlib.machinery
import importlib.util
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType


@dataclass(frozen=True, slots=True)
class Mutant:
    """``old`` stands exactly once in the module's source, and becomes ``new``."""

    name: str
    module: str
    old: str
    new: str


MUTANTS: tuple[Mutant, ...] = (
    Mutant(
        "fires after the arm's promise has ended",
        "tapping_cell.logic.tapper",
        "if self.state is not S.FIRING or end > permit.until:",
        "if self.state is not S.FIRING:",
    ),
    Mutant(
        "fires without asking the arm",
        "tapping_cell.logic.tapper",
        '        token = ("hold", self._tap.tap_id, self._attempts)\n'
        '        self._effects.append(Call("hold_still", request, token, HOLD_TIMEOUT_S))\n',
        "        shot = request.tap_id\n"
        "        self._permit = Permit(shot, math.inf)\n"
        "        self._machine.move(Event.HELD, S.FIRING)\n"
        '        self._run("fire", partial(tapper_jobs.fire, shot=shot, '
        "doubt=self.doubt_firing))\n",
    ),
    Mutant(
        "counts the promise from its answer",
        "tapping_cell.logic.tapper",
        "until = self._asked_at + HOLD_S",
        "until = now.steady + HOLD_S",
    ),
    Mutant(
        "fires although the arm refuses to hold still",
        "tapping_cell.logic.tapper",
        "if response is not None and not response.granted:",
        "if False:",
    ),
    Mutant(
        "tells an unknown outcome as not fired",
        "tapping_cell.logic.tapper",
        "FireOutcome.UNKNOWN: TapperState.UNKNOWN",
        "FireOutcome.UNKNOWN: TapperState.NOT_FIRED",
    ),
    Mutant(
        "tells every shot as fired",
        "tapping_cell.logic.tapper",
        "FireOutcome.NOT_FIRED: TapperState.NOT_FIRED",
        "FireOutcome.NOT_FIRED: TapperState.FIRED",
    ),
    Mutant(
        "serves a tap id twice",
        "tapping_cell.logic.tap_commands",
        "if command.tap_id <= last_tap_id:",
        "if False:",
    ),
    Mutant(
        "takes a second tap while one is served",
        "tapping_cell.logic.tapper",
        "        if self.state is not S.SAFE:\n            serving =",
        "        if False:\n            serving =",
    ),
    Mutant(
        "fires at an object that was moved",
        "tapping_cell.logic.tapper_peers",
        "            or self._disturbance(planned, now)\n",
        "",
    ),
    Mutant(
        "looks at the object's position only",
        "tapping_cell.logic.tapper_peers",
        "if moved <= limits.moved and turned <= limits.turned:",
        "if moved <= limits.moved:",
    ),
    Mutant(
        "fires without a planner",
        "tapping_cell.logic.tapper_peers",
        "            or self._silence(now)\n",
        "",
    ),
    Mutant(
        "does not miss the object",
        "tapping_cell.logic.tapper_peers",
        "if self._seen is None or unseen > limits.unseen:",
        "if self._seen is None:",
    ),
    Mutant(
        "fires whatever the last check says",
        "tapping_cell.logic.tapper_jobs",
        "refusal = context.ask(lambda now: doubt(release_by, now))\n"
        "        return refusal is None and not context.abandoned()",
        "refusal = context.ask(lambda now: doubt(release_by, now))\n"
        "        refusal = None\n"
        "        return True",
    ),
    Mutant(
        "keeps the striker charged when the tap is given up",
        "tapping_cell.logic.tapper",
        "        elif self.state is S.CHARGED:\n            self._discharge(why)\n",
        "        elif self.state is S.CHARGED:\n            pass\n",
    ),
    Mutant(
        "does not stop the wire",
        "tapping_cell.logic.device",
        "                # Nothing goes before the stop on the wire.\n"
        "                self._effects.append(StopWire())\n",
        "                pass\n",
    ),
    Mutant(
        "forgets a stop over a restart",
        "tapping_cell.logic.device",
        "            self._stops.recall(event.kept_stop)\n",
        "",
    ),
    Mutant(
        "does not keep a stop on disk",
        "tapping_cell.logic.device",
        "self._effects.append(KeepStop(self._stops.content()))",
        "pass",
    ),
    Mutant(
        "does not hear the emergency stop",
        "tapping_cell.logic.stops",
        "            changed = self._add(TOPIC) or changed\n",
        "",
    ),
    Mutant(
        "resets while the emergency stop is held",
        "tapping_cell.logic.stops",
        "        if levels.asserted:\n            self._asserted = True\n",
        "        if False:\n            self._asserted = True\n",
    ),
    Mutant(
        "a job that was overtaken changes the state",
        "tapping_cell.logic.device",
        "        elif event.job == self._job:\n            self._job = None\n",
        "        elif True:\n            self._job = None\n",
    ),
    Mutant(
        "does not promise to stand still",
        "tapping_cell.logic.arm",
        "        self._promise_end = max(self._promise_end, end)\n",
        "",
    ),
    Mutant(
        "promises while it moves",
        "tapping_cell.logic.arm",
        "if not self._active or self.state is not S.IN_POSITION or request.tap_id != self._tap_id:",
        "if not self._active:",
    ),
    Mutant(
        "moves in the flight of the striker",
        "tapping_cell.logic.tapper",
        "self._let_arm_go(RELEASED_S if end.outcome is FireOutcome.FIRED else 0.0)",
        "self._let_arm_go(0.0)",
    ),
    Mutant(
        "leaves before its promise is over",
        "tapping_cell.logic.arm",
        "partial(arm_jobs.withdraw, plan=plan, not_before=self._promise_end)",
        "partial(arm_jobs.withdraw, plan=plan, not_before=0.0)",
    ),
    Mutant(
        "lets anybody end the arm's promise",
        "tapping_cell.logic.arm",
        "if request.key and asker == self._promised_to and now",
        "if now",
    ),
    Mutant(
        "takes a trajectory while a tap is pending",
        "tapping_cell.logic.arm",
        "        if not self._active or self.state is not S.IDLE:\n"
        "            code = ErrorCode.ARM_BUSY",
        "        if not self._active:\n            code = ErrorCode.ARM_BUSY",
    ),
    Mutant(
        "homes by itself when activated",
        "tapping_cell.logic.arm",
        "alone = self._options.home_on_activate and not",
        "alone = not",
    ),
    Mutant(
        "believes an arm that was not homed",
        "tapping_cell.logic.arm",
        "        elif self._homed():\n            self._machine.move(event, S.IDLE)",
        "        elif True:\n            self._machine.move(event, S.IDLE)",
    ),
    Mutant(
        "takes a tap while it is busy",
        "tapping_cell.logic.arm",
        "        if self.state is not S.IDLE:\n            return ErrorCode.ARM_BUSY",
        "        if False:\n            return ErrorCode.ARM_BUSY",
    ),
    Mutant(
        "never gives a goal up",
        "tapping_cell.logic.planner",
        "        if now.steady > task.expires:",
        "        if False:",
    ),
    Mutant(
        "waits for ever for the arm",
        "tapping_cell.logic.planner",
        "        elif self._late(now):\n            self._fail(code, sentence",
        "        elif False:\n            self._fail(code, sentence",
    ),
    Mutant(
        "decides on an object that still slides",
        "tapping_cell.logic.cell_monitor",
        "            and seen.at_rest\n            and seen.error_code",
        "            and seen.error_code",
    ),
    Mutant(
        "does not withdraw a tap after its outcome",
        "tapping_cell.logic.planner",
        "        self._withdraw(shot.tap_id, now)\n        task.not_fired =",
        "        task.not_fired =",
    ),
    Mutant(
        "commands the same tap id again",
        "tapping_cell.logic.planner",
        "            self._last_tap_id + 1, now.ros // NANOSECONDS, "
        "self._monitor.last_tap_id() + 1\n",
        "            self._last_tap_id, now.ros // (100 * NANOSECONDS), "
        "self._monitor.last_tap_id()\n",
    ),
    Mutant(
        "samples the board's time after the last check",
        "tapping_cell.hardware.tapper",
        "        sample = self._request(Command.STATUS)\n"
        "        sampled_at = self._transport.now()\n"
        "        if sample",
        "        asked_at = self._transport.now()\n"
        "        allowed = still_allowed(self._latest_release(asked_at, window))\n"
        "        sample = self._request(Command.STATUS)\n"
        "        sampled_at = self._transport.now()\n"
        "        still_allowed = lambda _: allowed  # noqa: E731\n"
        "        if sample",
    ),
    Mutant(
        "a missing reply to FIRE counts as not fired",
        "tapping_cell.hardware.tapper",
        '            return self._unknown(shot, release_by, "the tapper does not answer")',
        '            return self._not_fired(shot, "the tapper does not answer")',
    ),
    Mutant(
        "a restarted board's word counts for the shot",
        "tapping_cell.hardware.tapper",
        "        if reply.boot != boot:\n"
        "            self._boot = None\n"
        "            return self._unknown(shot, release_by",
        "        if False:\n"
        "            self._boot = None\n"
        "            return self._unknown(shot, release_by",
    ),
    Mutant(
        "a move counts as done wherever it ended",
        "tapping_cell.hardware.arm",
        "                if not reading.moving and self._agrees(goal, reading.joints):",
        "                if True:",
    ),
    Mutant(
        "homing is kept over a reset of the board",
        "tapping_cell.hardware.arm",
        "if not (firmware.continued and held and not reading.alarm):",
        "if False:",
    ),
)


class MutantError(Exception):
    """A mutant no longer fits the source that it changes."""


class _Loader(importlib.machinery.SourceFileLoader):
    """Loads a module with a mutant in it."""

    def __init__(self, name: str, path: str, mutant: Mutant) -> None:
        super().__init__(name, path)
        self._mutant = mutant

    def get_code(self, fullname: str):  # type: ignore[no-untyped-def]
        """The code of the changed source; never from a cache."""
        return compile(mutated(self._mutant), self.path, "exec", dont_inherit=True)


class _Finder(importlib.abc.MetaPathFinder):
    """Finds the module of a mutant before anybody else does."""

    def __init__(self, mutant: Mutant) -> None:
        self._mutant = mutant

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """The specification of the module with the mutant; None for every other."""
        if name != self._mutant.module:
            return None
        source = str(_source_of(self._mutant.module))
        loader = _Loader(name, source, self._mutant)
        return importlib.util.spec_from_loader(name, loader)


def _source_of(module: str) -> Path:
    package = Path(__file__).resolve().parents[1]
    return package.joinpath(*module.split(".")[1:]).with_suffix(".py")


def mutated(mutant: Mutant) -> str:
    """The changed source of a mutant's module.

    Raises:
        MutantError: what is to be replaced does not stand in it exactly once.
    """
    source = _source_of(mutant.module).read_text(encoding="utf-8")
    count = source.count(mutant.old)
    if count != 1:
        raise MutantError(
            f"mutant '{mutant.name}': its text stands {count} times in {mutant.module}; it must"
            " stand there once"
        )
    return source.replace(mutant.old, mutant.new)


def plant(mutant: Mutant) -> None:
    """Plant a mutant in this process, before its module is imported.

    Raises:
        MutantError: the module was imported already, or the mutant no longer fits.
    """
    mutated(mutant)
    if mutant.module in sys.modules:
        raise MutantError(f"{mutant.module} was imported before mutant '{mutant.name}' was planted")
    sys.meta_path.insert(0, _Finder(mutant))
