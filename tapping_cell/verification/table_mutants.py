"""Defects of a cell with several objects that its invariants must detect; see ``mutants``."""

from __future__ import annotations

from tapping_cell.verification.mutants import Mutant

ARRANGEMENT = "tapping_cell.logic.arrangement"
OTHERS = "tapping_cell.logic.other_objects"
HANDLING = "tapping_cell.logic.goal_handling"
PEERS = "tapping_cell.logic.tapper_peers"
PLANNER = "tapping_cell.logic.planner"

TABLE_MUTANTS: tuple[Mutant, ...] = (
    Mutant(
        "arranges on although another object was moved",
        ARRANGEMENT,
        "        return any(\n            monitor.moved(",
        "        return False and any(\n            monitor.moved(",
        kinds=("other object moved",),
        several=True,
    ),
    Mutant(
        "arranges on although an object appeared",
        ARRANGEMENT,
        "any(monitor.sees(body.name) for body in self.bodies if body.name not in self._seen)",
        "False",
        kinds=("other object removed",),
        several=True,
    ),
    Mutant(
        "ignores a hidden object at once",
        ARRANGEMENT,
        "                absent = absent and monitor.missing_for(now) > self.memory\n",
        "",
        kinds=("other object hidden",),
        several=True,
    ),
    Mutant(
        "waits for an object that was taken away",
        ARRANGEMENT,
        "                if absent and monitor.observed_at(now) > after:\n",
        "                if False:\n",
        kinds=("other object removed",),
        several=True,
    ),
    Mutant(
        "taps on although an obstacle was moved",
        OTHERS,
        "return any(area is not None and area not in areas for area in self.areas(now))",
        "return False",
        kinds=("other object moved",),
        several=True,
    ),
    Mutant(
        "plans among obstacles that were not observed",
        OTHERS,
        "if file.name not in self._known or self._known[file.name].observed_at <= since",
        "if False",
        kinds=("late object states",),
        several=True,
    ),
    Mutant(
        "arranges objects that were not all observed",
        ARRANGEMENT,
        "if not monitor.usable(after, frames, now):",
        "if body.name == self.object_id and not monitor.usable(after, frames, now):",
        kinds=("late object states", "other object moved"),
        several=True,
    ),
    Mutant(
        "plans among the obstacles of the previous tap",
        HANDLING,
        "        self._locate_others(now)\n        self._planned_among = self.others\n",
        "        self._planned_among = self.other_objects.areas(now)\n",
        kinds=("other object moved",),
        several=True,
    ),
    Mutant(
        "checks the pose of the cell's own object only",
        PEERS,
        "        self._object, self._height = object_id, height\n",
        '        self._object, self._height = "", height\n',
        kinds=("cancel",),
        several=True,
    ),
    Mutant(
        "fires at another object wherever it is",
        PEERS,
        "            if moved <= limits.moved and turned <= limits.turned:\n",
        "            if self._object or (moved <= limits.moved and turned <= limits.turned):\n",
        kinds=("other object moved", "other object turned"),
        several=True,
    ),
    Mutant(
        "resumes an arrangement after a crash",
        ARRANGEMENT,
        "    resumable: ClassVar[bool] = False\n",
        "    resumable: ClassVar[bool] = True\n",
        kinds=("kill",),
        several=True,
    ),
    Mutant(
        "reports objects at their goals that are not",
        ARRANGEMENT,
        "            elif name in self.arrangement.finished:\n",
        "            elif name:\n",
        kinds=("cancel", "emergency stop"),
        several=True,
    ),
    Mutant(
        "decides on objects that were moved during the decision",
        PLANNER,
        "        if outdated or self._obstacles_changed(task):\n",
        "        if self._obstacles_changed(task):\n",
        kinds=("other object moved", "object moved"),
        several=True,
    ),
    Mutant(
        "acts on a decision of an earlier goal",
        PLANNER,
        "        awaited = isinstance(event, JobEnded) and event.job == self._computation\n",
        "        awaited = isinstance(event, JobEnded)\n",
        kinds=("cancel", "second client"),
        several=True,
    ),
    Mutant(
        "plans without a search for unknown objects",
        HANDLING,
        "        if not self.other_objects.searched(search_since):\n",
        "        if False:\n",
        kinds=("unknown object", "late object states"),
        several=True,
    ),
    Mutant(
        "arranges through unknown objects",
        HANDLING,
        "            task.avoid(self.other_objects.unknown)\n",
        "            pass\n",
        kinds=("unknown object",),
        several=True,
    ),
    Mutant(
        "plans through unknown objects",
        OTHERS,
        "return (*(self._area(file, now) for file in self._files), *self._unknown)",
        "return tuple(self._area(file, now) for file in self._files)",
        kinds=("unknown object",),
        several=True,
    ),
    Mutant(
        "arranges on although an unknown object was found",
        PLANNER,
        "return task.obstacles != self.goals.other_objects.unknown",
        "return False",
        kinds=("unknown object", "late object states", "late object states"),
        several=True,
    ),
)
