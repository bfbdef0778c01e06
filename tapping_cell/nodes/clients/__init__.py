"""Clients of a running cell, used by the command line."""
