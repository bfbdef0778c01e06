"""Simulated world for tests of the cell: sliding dynamics, rendered camera, serial devices."""
