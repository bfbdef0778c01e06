"""Faults that a run injects."""
