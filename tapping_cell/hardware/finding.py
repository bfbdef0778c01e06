"""Comparison of a controller's setting with the value that the arm requires."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Finding:
    """Comparison of one controller setting with its required value."""

    setting: str
    found: str
    """Value of the setting; "missing" if the controller does not report it."""
    needed: str
    """Requirement, such as "must be 255"."""
    met: bool
    command: str = ""
    """Command to type at the controller to correct the setting; empty if there is no such
    command."""
    storable: bool = False
    """True if the command may be sent without an operator at the arm, because it changes neither
    the scale nor the speed of any motion."""

    @property
    def sentence(self) -> str:
        """Sentence that states the difference and how to correct it."""
        remedy = f" (send {self.command})" if self.command else ""
        is_missing = "is missing" if self.found == "missing" else f"is {self.found}"
        return f"{self.setting} {is_missing}, {self.needed}{remedy}"
