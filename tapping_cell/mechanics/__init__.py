"""Mechanics of a tap: bodies, support friction, sliding, impact and the whole tap."""

from tapping_cell.mechanics.bodies import Body, Disk, Polygon, Ring
from tapping_cell.mechanics.errors import (
    InvalidBodyError,
    InvalidParameterError,
    MechanicsError,
    UnreachableDisplacementError,
)
from tapping_cell.mechanics.impact import Impact, ImpactResult, Striker
from tapping_cell.mechanics.slide_results import Launch, Profile, Rest
from tapping_cell.mechanics.sliding import Sliding
from tapping_cell.mechanics.tap import Tap, TapPlan, TapResult

__all__ = [
    "Body",
    "Disk",
    "Impact",
    "ImpactResult",
    "InvalidBodyError",
    "InvalidParameterError",
    "Launch",
    "MechanicsError",
    "Polygon",
    "Profile",
    "Rest",
    "Ring",
    "Sliding",
    "Striker",
    "Tap",
    "TapPlan",
    "TapResult",
    "UnreachableDisplacementError",
]
