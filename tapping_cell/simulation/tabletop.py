"""Several objects on one simulated table: a struck object slides and may collide with others.

Each object is a ``World``. The tabletop advances all worlds to the same time, lets the striker hit
the first object in its path, and computes collisions (``simulation.collision``). The time steps are
shortened before a contact, so that objects overlap by less than 0.1 mm.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tapping_cell.configuration.objects import ObjectFile
from tapping_cell.mechanics import Striker
from tapping_cell.se2 import Pose
from tapping_cell.simulation.collision import gap_between, impact
from tapping_cell.simulation.truth import TruthFile
from tapping_cell.simulation.world import World

SHORTEST_STEP_S, LONGEST_STEP_S = 1e-4, 2e-3
TOUCHING_M = 2e-5
"""Distance below which two objects touch, m."""
NOTED_SPEED = 0.001
"""Minimum closing speed of a reported contact, m/s. It excludes objects that slide side by side."""
APART_S = 0.05
"""Time after a contact within which further contacts of the same objects are ignored, s."""
START_GAP_M = 0.04
"""Minimum gap between a randomly placed object and the others, m."""
EDGE_M = 0.06
"""Minimum gap between a randomly placed object's outline and the table's edge, m."""
TRIES, RESTARTS = 300, 40


@dataclass(frozen=True, slots=True)
class TrueContact:
    """Contact of two objects: ``name`` moved and hit ``other``. Time in s, point in ``table`` in m,
    closing speed in m/s."""

    name: str
    other: str
    time: float
    place: tuple[float, float]
    closing_speed: float


class Tabletop:
    """The objects of a cell on its table. Times are in s and must not decrease between calls."""

    def __init__(
        self,
        contents: Sequence[ObjectFile],
        striker: Striker,
        stroke: float,
        truth: TruthFile,
        seed: int,
        size: tuple[float, float],
    ) -> None:
        """``contents``: object files, beginning with the cell's own object. ``stroke``: see
        ``World``. ``size``: length and width of the table, m.

        Raises:
            ValueError: there is not enough free space, or a centre of mass is outside its support.
        """
        self.worlds: dict[str, World] = {
            content.name: World(
                content, striker, stroke, truth, seed if number == 0 else _seed(seed, number)
            )
            for number, content in enumerate(contents)
        }
        self._size = size
        self._random = _seed(seed, len(contents))
        self._now = -math.inf
        self._met: dict[frozenset[str], float] = {}
        self._contacts: list[TrueContact] = []
        self._tapped = next(iter(self.worlds))
        self._place_all(truth)

    @property
    def poses(self) -> Mapping[str, Pose]:
        """Poses of all objects at the time of the last ``advance``."""
        return {name: world.pose for name, world in self.worlds.items()}

    @property
    def at_rest(self) -> bool:
        """True when no object moves or is about to be hit."""
        return all(world.at_rest for world in self.worlds.values())

    def advance(self, now: float) -> None:
        """Advance the simulation to ``now``."""
        if math.isinf(self._now):
            self._advance_all(now)
        while self._now < now:
            if len(self.worlds) == 1 or self.at_rest:
                self._advance_all(now)
                continue
            pairs = self._pairs()
            self._advance_all(min(now, self._now + self._step_length(pairs)))
            self._collide(self._pairs())

    def strike(self, tip: Pose, tip_height: float, speed: float, now: float) -> bool:
        """Release the striker (see ``World.strike``); the first object in its path is struck."""
        self.advance(now)
        travels = {
            name: world.travel_to_meet(tip, tip_height, speed)
            for name, world in self.worlds.items()
        }
        name = min(travels, key=lambda each: travels[each])
        if math.isinf(travels[name]):
            # The striker hits no object at its current pose, but a sliding object may still enter
            # its path.
            moving = [each for each, world in self.worlds.items() if not world.at_rest]
            name = moving[0] if moving else name
        self._tapped = name
        return self.worlds[name].strike(tip, tip_height, speed, now)

    def take_striker(self, striker: Striker, stroke: float) -> None:
        """Change the striker, see ``World.take_striker``."""
        for world in self.worlds.values():
            world.take_striker(striker, stroke)

    def travel_to_meet(self, tip: Pose, tip_height: float, speed: float) -> float:
        """Return ``World.travel_to_meet`` for the first object in the striker's path."""
        return min(world.travel_to_meet(tip, tip_height, speed) for world in self.worlds.values())

    def gate_speed(self, speed: float) -> float:
        """Return the speed that the tapper's speed gate measures; see ``World.gate_speed``."""
        return next(iter(self.worlds.values())).gate_speed(speed)

    def reseed(self, seed: int) -> None:
        """Restart the random numbers with a new seed."""
        for number, world in enumerate(self.worlds.values()):
            world.reseed(seed if number == 0 else int(_seed(seed, number).integers(2**31)))
        self._random = _seed(seed, len(self.worlds))

    def place(self, name: str, pose: Pose) -> None:
        """Place an object at a pose, at rest."""
        self.worlds[name].place(pose)

    def free_pose(
        self,
        name: str,
        others: Sequence[str] | None = None,
        disc: tuple[float, float, float] | None = None,
    ) -> Pose:
        """Return a random pose on the table, away from its edges and from the other objects.

        ``disc``: x and y of the centre, and radius, of a disc that must contain the object's
        centre, m.

        Raises:
            ValueError: there is not enough free space.
        """
        world = self.worlds[name]
        names = list(self.worlds) if others is None else others
        half = np.maximum(np.array(self._size) / 2 - world.solid.reach - EDGE_M, 0.0)
        for _ in range(TRIES):
            x, y = self._random.uniform(-half, half).tolist()
            pose = Pose(x, y, float(self._random.uniform(-math.pi, math.pi)))
            if disc is not None and math.hypot(x - disc[0], y - disc[1]) > disc[2]:
                continue
            if all(
                pose.distance_to(self.worlds[each].pose)
                >= START_GAP_M + world.solid.reach + self.worlds[each].solid.reach
                for each in names
                if each != name
            ):
                return pose
        raise ValueError(
            f"there is no free place for '{name}' on a table of {1000 * self._size[0]:.0f} x "
            f"{1000 * self._size[1]:.0f} mm with {len(names)} objects; use fewer or smaller "
            "objects, or give their poses in the simulation parameters (key 'further_starts')"
        )

    def spread(self, names: Sequence[str], placed: Sequence[str] = ()) -> None:
        """Place objects at random poses, free of each other and of the objects ``placed``.

        Raises:
            ValueError: there is not enough free space.
        """
        for attempt in range(RESTARTS):
            done = list(placed)
            try:
                for name in names:
                    self.worlds[name].place(self.free_pose(name, done))
                    done.append(name)
            except ValueError:
                # The objects that were already placed may be in unfavourable places, so start over.
                if attempt == RESTARTS - 1:
                    raise
            else:
                return

    def take_contacts(self) -> list[TrueContact]:
        """Return the contacts between objects since the last call."""
        contacts, self._contacts = self._contacts, []
        return contacts

    def _place_all(self, truth: TruthFile) -> None:
        """Place the further objects at the poses in the simulation parameters, or at random free
        poses."""
        own, *further = self.worlds
        for name, start in zip(further, truth.further_starts, strict=False):
            self.worlds[name].place(Pose(*start))
        count = len(truth.further_starts)
        self.spread(further[count:], [own, *further[:count]])

    def _advance_all(self, now: float) -> None:
        self._now = max(self._now, now)
        for world in self.worlds.values():
            world.advance(self._now)

    def _pairs(self) -> list[tuple[str, str, float]]:
        """Return each pair of objects of which at least one moves, and an upper bound of the
        pair's closing speed, m/s."""
        speeds = {}
        for name, world in self.worlds.items():
            vx, vy, omega = world.twist
            speeds[name] = math.hypot(vx, vy) + abs(omega) * world.solid.reach
        return [
            (first, second, speeds[first] + speeds[second])
            for first, second in itertools.combinations(self.worlds, 2)
            if speeds[first] + speeds[second] > 0.0
        ]

    def _step_length(self, pairs: Sequence[tuple[str, str, float]]) -> float:
        """Return a time step in which no two objects can meet, s."""
        # An object that the striker may still hit can become faster; all other objects only slow
        # down.
        struck = any(world.struck for world in self.worlds.values())
        longest = LONGEST_STEP_S if struck else math.inf
        for first, second, speed in pairs:
            one, other = self.worlds[first], self.worlds[second]
            apart = _clearance(one, other)
            if apart <= longest * speed:
                apart = gap_between(one.solid, other.solid, one.motion, other.motion).distance
            longest = min(longest, max(apart / speed, SHORTEST_STEP_S))
        return longest

    def _collide(self, pairs: Sequence[tuple[str, str, float]]) -> None:
        for first, second, speed in pairs:
            one, other = self.worlds[first], self.worlds[second]
            apart = _clearance(one, other)
            if apart > TOUCHING_M + speed * SHORTEST_STEP_S:
                continue
            gap = gap_between(one.solid, other.solid, one.motion, other.motion)
            if gap.distance > TOUCHING_M:
                continue
            after = impact(one.solid, other.solid, one.motion, other.motion, gap)
            if after is None:
                continue
            one.go_on(after[0])
            other.go_on(after[1])
            pair = frozenset((first, second))
            new = self._now - self._met.get(pair, -math.inf) > APART_S
            self._met[pair] = self._now
            if new and after[2] > NOTED_SPEED:
                came, met = (second, first) if second == self._tapped else (first, second)
                self._contacts.append(TrueContact(came, met, self._now, gap.place, after[2]))


def _clearance(one: World, other: World) -> float:
    """Return a lower bound, m, of the distance between two objects. The bound holds for any
    rotation of the objects."""
    here, there = one.motion, other.motion
    between = math.hypot(here.x - there.x, here.y - there.y)
    return between - one.solid.reach - other.solid.reach


def _seed(seed: int, number: int) -> np.random.Generator:
    return np.random.default_rng([seed, number])
