"""Square markers: detection, edges, and the pose of the object that carries one."""
