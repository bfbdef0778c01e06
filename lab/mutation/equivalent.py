"""Mutants that change no behaviour, or only one that nobody needs: their ids, with the reason."""

from __future__ import annotations

REASONS: dict[str, str] = {}
