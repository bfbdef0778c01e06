"""The ROS 2 nodes: parameters, topics and a state machine each, and no mathematics."""
