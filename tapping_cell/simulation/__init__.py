"""The world that the cell is tried in: sliding in time, rendered camera, serial devices."""
