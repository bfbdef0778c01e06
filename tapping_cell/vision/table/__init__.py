"""The pose of the camera over the table, from the reference markers."""
