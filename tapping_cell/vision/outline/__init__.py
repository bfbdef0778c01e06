"""Objects without a marker: their pose from the outline of their top."""
