"""Search for a violation caused by one mutant: ``python -m tapping_cell.verification.hunt``.

This is a separate program, because a mutant must be applied before its module is imported.
"""

from __future__ import annotations

import argparse
import json
import sys

from tapping_cell.verification.all_mutants import ALL_MUTANTS
from tapping_cell.verification.mutants import plant


def main() -> int:
    """Apply the mutant, and run goals until a violation occurs or ``--goals`` goals have been run.
    Print the number of goals and the name of the violated invariant (empty if no violation
    occurred) as JSON. The exit code is 1 if the simulator itself failed, which says nothing about
    the mutant."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", choices=[mutant.name for mutant in ALL_MUTANTS])
    parser.add_argument("--goals", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--core", type=int, default=0, help="the core to stay on")
    arguments = parser.parse_args()
    (mutant,) = (mutant for mutant in ALL_MUTANTS if mutant.name == arguments.name)
    plant(mutant)
    from tapping_cell.verification.campaign import (  # imported only after the mutant is applied
        run_campaign,
        settle_on,
    )
    from tapping_cell.verification.faults import Mix
    from tapping_cell.verification.trial import SIMULATOR_DEFECT

    settle_on(arguments.core)

    mix = Mix(
        mutant.kinds,
        fixed=mutant.fixed,
        several=mutant.several,
        set_up=mutant.set_up,
        ask=mutant.ask,
    )
    summary = run_campaign(arguments.goals, arguments.seed, 1, stop_at_violation=True, mix=mix)
    for seed, violation in summary.violations:
        if violation.name == SIMULATOR_DEFECT:
            print(f"the simulator itself failed in run {seed}: {violation.sentence}")
            return 1
    caught = summary.violations[0][1].name if summary.violations else ""
    print(json.dumps({"goals": summary.goals, "caught by": caught}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
