"""Exceptions of planning. If a goal or a tap is refused, no exception is raised; the result is a
``Refusal``."""

from __future__ import annotations


class PlanningError(ValueError):
    """A setting or an argument of planning is invalid; the message names it."""


class UnknownPlannerError(PlanningError):
    """Planner name that is neither built in nor registered as an entry point."""
