"""From measurements to files in ``config/``: camera, table, arm, tapper and object."""
