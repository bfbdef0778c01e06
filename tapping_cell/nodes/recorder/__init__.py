"""The node ``run_recorder``, which writes a run folder for every goal."""
