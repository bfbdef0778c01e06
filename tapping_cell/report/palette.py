"""Colours of drawings, charts and plots in reports.

The operator's page has its own colours in ``nodes/page/static/style.css``, for light and dark mode.
"""

from __future__ import annotations

INK = "#1c2733"
MUTED = "#66727f"
START = "#5b6570"
REST = "#1f6fb4"
GOAL = "#218a4c"
STRIKE = "#c8372d"
PREDICTED = "#d98a00"
WAITING = "#9aa5b1"
CONFIRMING = "#5a3d8a"
PLANNING = "#7a5bb0"
SLIDING = "#4aa3a2"
LOWERING = "#f0b95a"
WITHDRAWING = "#b98bd0"
TABLE = "#faf8f2"
SERIES = (REST, STRIKE, GOAL, PREDICTED, PLANNING, SLIDING, "#8c5a2b", START)
"""Colours of the groups of a comparison, in order."""
