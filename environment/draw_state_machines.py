"""Write ``docs/state_machines.md`` from the transition tables of the state machines.

After a change of a table, run ``python environment/draw_state_machines.py``; a test compares the
page with the tables.
"""

from __future__ import annotations

from pathlib import Path

from tapping_cell.logic import arm_states, planner_states, tapper_states
from tapping_cell.logic.transitions import diagram

TARGET = Path(__file__).resolve().parents[1] / "docs" / "state_machines.md"


def page() -> str:
    """Return the text of the page."""
    return f"""# State machines

`python environment/draw_state_machines.py` generates this page from the tables in
`tapping_cell/logic`. A transition that is not drawn is not permitted: if it occurred, the node
would enter a safe state and report code 904. `stop` leaves any state of arm and tapper;
`clear_fault` ends the stop.

## Arm

In `Leaving` the arm waits until its promise to stand still has ended ([safety.md](safety.md));
`arm_state` reports this state as WITHDRAWING. `Inactive` is reported as FAULT with code 903.

```mermaid
{diagram(arm_states.TABLE, arm_states.State.DISCONNECTED)}
```

## Tapper

In `Waiting` the tapper has a tap and waits for the arm; `tapper_state` reports this state as SAFE.
In `Charged` the tapper requests the arm's promise to stand still.

```mermaid
{diagram(tapper_states.TABLE, tapper_states.State.DISCONNECTED)}
```

## Planner

The planner does not latch a stop. An emergency stop ends the current goal. The planner refuses
further goals while the arm or the tapper reports a stop or a fault.

```mermaid
{diagram(planner_states.TABLE, planner_states.State.IDLE)}
```
"""


if __name__ == "__main__":
    TARGET.write_text(page(), encoding="utf-8")
    print(f"wrote {TARGET}")
