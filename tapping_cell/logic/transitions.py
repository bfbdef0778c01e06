"""State machines defined by transition tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Generic, TypeVar

State = TypeVar("State", bound=Enum)
Event = TypeVar("Event", bound=Enum)
Record = TypeVar("Record")


class UndefinedTransition(Exception):
    """An event occurred that the transition table does not allow: a defect of this program."""


@dataclass(frozen=True, slots=True)
class Go(Generic[Event, Record]):
    """Step of a cycle: go to the state of ``record``. Without an event, the state remains, and only
    its data changes."""

    event: Event | None
    record: Record


class StateMachine(Generic[State, Event]):
    """A state machine that allows only the transitions of its table.

    ``table`` maps a state and an event to the states that may follow. The caller of ``move``
    selects one of them.
    """

    def __init__(
        self, table: Mapping[tuple[State, Event], frozenset[State]], initial: State
    ) -> None:
        self._table = table
        self._state = initial

    @property
    def state(self) -> State:
        """Present state."""
        return self._state

    def move(self, event: Event, target: State) -> None:
        """Go to a state. Raises UndefinedTransition if the table does not allow it."""
        check(self._table, self._state, event, target)
        self._state = target


def check(
    table: Mapping[tuple[State, Event], frozenset[State]], state: State, event: Event, target: State
) -> None:
    """Raise UndefinedTransition if the table does not allow this transition."""
    if target not in table.get((state, event), frozenset()):
        raise UndefinedTransition(
            f"{event.value} in state {state.value} does not lead to {target.value}"
        )


def table(
    rows: Iterable[tuple[Iterable[State], Event, Iterable[State]]],
) -> dict[tuple[State, Event], frozenset[State]]:
    """Return a transition table made from rows (states, event, following states).

    Raises:
        ValueError: two rows are for the same state and event.
    """
    made: dict[tuple[State, Event], frozenset[State]] = {}
    for states, event, targets in rows:
        for state in states:
            if (state, event) in made:
                raise ValueError(f"two rows for {state.value} and {event.value}")
            made[state, event] = frozenset(targets)
    return made


def diagram(rules: Mapping[tuple[State, Event], frozenset[State]], initial: State) -> str:
    """Return a table as a Mermaid state diagram with one arrow for each pair of states."""
    labels: dict[tuple[str, str], list[str]] = {}
    for (state, event), targets in rules.items():
        for target in targets:
            labels.setdefault((state.value, target.value), []).append(event.value)
    lines = ["stateDiagram-v2", f"    [*] --> {initial.value}"]
    lines += [
        f"    {start} --> {end}: {', '.join(sorted(events))}"
        for (start, end), events in sorted(labels.items())
    ]
    return "\n".join(lines)
