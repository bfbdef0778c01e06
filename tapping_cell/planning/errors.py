"""What planning refuses by raising; a refused goal or tap is a value (``Refusal``) instead."""

from __future__ import annotations


class PlanningError(ValueError):
    """A setting or an argument of planning that makes no sense; the sentence says which."""


class UnknownPlannerError(PlanningError):
    """A planner's name that is neither built in nor registered as an entry point."""
