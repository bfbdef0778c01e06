"""Oracles: what must never happen in any run."""
