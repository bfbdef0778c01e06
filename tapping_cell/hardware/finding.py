"""A controller's setting held against what the arm needs."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Finding:
    """One setting of a controller held against what is needed."""

    setting: str
    found: str
    """Its value; "missing" where the controller does not tell."""
    needed: str
    """Such as "must be 255"."""
    met: bool
    command: str = ""
    """What is typed at the controller to mend it; empty where that is no line of text."""
    storable: bool = False
    """Whether the command may be sent without a person at the arm: it changes neither the scale
    nor the speed of any motion."""

    @property
    def sentence(self) -> str:
        """The difference and its remedy."""
        remedy = f" (send {self.command})" if self.command else ""
        is_missing = "is missing" if self.found == "missing" else f"is {self.found}"
        return f"{self.setting} {is_missing}, {self.needed}{remedy}"
