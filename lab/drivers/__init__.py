"""Trials of the drivers with emulated controllers and boards."""
