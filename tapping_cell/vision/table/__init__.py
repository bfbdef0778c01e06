"""Estimate of the camera's pose over the table from the reference markers."""
