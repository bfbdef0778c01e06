"""Write ``docs/state_machines.md`` from the tables of the machines; a test holds it in step.

Run it after a change of a table: ``python environment/draw_state_machines.py``.
"""

from __future__ import annotations

from pathlib import Path

from tapping_cell.logic import arm, planner, tapper
from tapping_cell.logic.transitions import diagram

TARGET = Path(__file__).resolve().parents[1] / "docs" / "state_machines.md"


def page() -> str:
    """The text of the page."""
    return f"""# State machines

Generated from the tables in `tapping_cell/logic` by `python environment/draw_state_machines.py`.
What is not drawn cannot happen: an undefined transition is an error, told as code 904 in a safe
state. Any state of arm and tapper can be left by `stop`, which `clear_fault` ends.

## Arm

`Leaving` waits for the promise to stand still to end ([safety.md](safety.md)); `arm_state` tells
it as WITHDRAWING. `Inactive` is told as FAULT with code 903.

```mermaid
{diagram(arm.TABLE, arm.State.DISCONNECTED)}
```

## Tapper

`Waiting` has a tap and waits for the arm; `tapper_state` tells it as SAFE. In `Charged` the arm is
asked to stand still.

```mermaid
{diagram(tapper.TABLE, tapper.State.DISCONNECTED)}
```

## Planner

The planner does not latch a stop: an emergency stop ends its goal, and arm and tapper refuse the
next one until they are cleared.

```mermaid
{diagram(planner.TABLE, planner.State.IDLE)}
```
"""


if __name__ == "__main__":
    TARGET.write_text(page(), encoding="utf-8")
    print(f"wrote {TARGET}")
