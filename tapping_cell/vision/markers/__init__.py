"""Square markers: detection, edges, and the pose of an object that carries a marker."""
