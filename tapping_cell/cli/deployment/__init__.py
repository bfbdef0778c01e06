"""Parts of the verbs ``deploy``, ``undeploy``, ``backup``, ``restore`` and ``bundle``."""
