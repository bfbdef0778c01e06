"""The nodes that read the camera and measure poses: ``overhead_camera`` and ``camera_pose``."""
