"""Calibration of camera, table, arm, tapper and object; the results go to files in ``config/``."""
