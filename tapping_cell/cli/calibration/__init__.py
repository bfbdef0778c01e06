"""Sub-verbs of ``calibrate``, with the same module interface as verbs."""
