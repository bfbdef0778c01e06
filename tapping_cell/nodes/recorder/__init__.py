"""The node ``run_recorder``: a run folder for every goal."""
