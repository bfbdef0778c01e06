"""Modules of the sub-verbs of ``object``. Each has ``add_arguments`` and ``run``, as the module of
a verb has."""
