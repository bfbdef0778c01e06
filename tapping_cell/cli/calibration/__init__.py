"""The sub-verbs of ``calibrate``: one module each, like verbs."""
