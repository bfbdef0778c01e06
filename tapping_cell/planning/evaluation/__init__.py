"""Evaluation of planning methods: many trials, on an open table or in a complete cell."""

from tapping_cell.planning.evaluation.open_table import run_open_trials
from tapping_cell.planning.evaluation.parallel import evaluate
from tapping_cell.planning.evaluation.summary import summarise
from tapping_cell.planning.evaluation.task import Evaluation, Results
from tapping_cell.planning.evaluation.worlds import PhysicsWorld

__all__ = [
    "Evaluation",
    "PhysicsWorld",
    "Results",
    "evaluate",
    "run_open_trials",
    "summarise",
]
