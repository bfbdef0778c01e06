"""Colours of the operator's page, of reports and of plots, for light and dark mode.

Plots use the constants, which are the colours in light mode. Pages use them as CSS variables
(:func:`css_variables`), and their drawings are recoloured in dark mode (:func:`css_of_drawings`).
"""

from __future__ import annotations

GROUND = "#eef1f4"
CARD = "#ffffff"
INK = "#14202b"
MUTED = "#4a5a68"
LINE = "#cdd6de"
BUTTON = "#e4eaf0"
STRONG = "#0b5cad"
STRONG_INK = "#f7fbff"
GOOD = "#12733b"
WARN = "#8a5300"
BAD = "#b3121d"
LOST = "#55606b"

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
"""Colours of curves or objects in one drawing, in the order in which they are assigned."""

DARK = {
    GROUND: "#0e151b",
    CARD: "#18222b",
    INK: "#eef4f9",
    MUTED: "#a9b8c5",
    LINE: "#33424f",
    BUTTON: "#2a3843",
    STRONG: "#3b8fe8",
    STRONG_INK: "#06121d",
    GOOD: "#4fd58a",
    WARN: "#ffb84d",
    BAD: "#ff7d7d",
    LOST: "#9aa7b2",
    START: "#b4c0cb",
    REST: "#5fb0f2",
    GOAL: "#4fd58a",
    STRIKE: "#ff8078",
    TABLE: "#1d2832",
}
"""Mapping from a colour in light mode to the colour in dark mode. Colours that are not listed are
the same in both modes."""

STOP = "#c8101e"
DISABLED_STOP = "#6b737b"
NOTICE = "#ffd45e"
NOTICE_INK = "#2a1d00"

PLANNED = "#27a7ff"
ARROW = "#ffd23f"
GHOST = "#ff5ce1"
REFUSED = "#ff5a4d"
"""Colours of drawings over the camera's image: the planned tap, its strike, a goal and a refused
goal."""

_VARIABLES = {
    "ground": GROUND,
    "card": CARD,
    "ink": INK,
    "muted": MUTED,
    "line": LINE,
    "button": BUTTON,
    "strong": STRONG,
    "strong-ink": STRONG_INK,
    "good": GOOD,
    "warn": WARN,
    "bad": BAD,
    "lost": LOST,
    "stop": STOP,
    "disabled-stop": DISABLED_STOP,
    "notice": NOTICE,
    "notice-ink": NOTICE_INK,
    "planned": PLANNED,
    "arrow": ARROW,
    "ghost": GHOST,
    "refused": REFUSED,
}


def css_variables() -> str:
    """Return the style rules that declare the colours, such as ``var(--ink)``, for both modes."""
    light = "".join(f"--{name}:{colour};" for name, colour in _VARIABLES.items())
    dark = "".join(
        f"--{name}:{DARK[colour]};" for name, colour in _VARIABLES.items() if colour in DARK
    )
    return (
        f":root{{color-scheme:light dark;{light}}}\n"
        f"@media screen and (prefers-color-scheme:dark){{:root{{{dark}}}}}\n"
    )


def css_of_drawings() -> str:
    """Return the style rules that give the drawings of a page their colours in dark mode."""
    rules = "".join(
        f'svg [{kind}="{light}"]{{{kind}:{dark}}}'
        for light, dark in DARK.items()
        for kind in ("fill", "stroke")
    )
    return f"@media screen and (prefers-color-scheme:dark){{{rules}}}\n"
