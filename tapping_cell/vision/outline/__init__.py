"""Objects without a marker: the pose from the outline of their top."""
