"""The nodes ``overhead_camera``, which reads the camera, and ``camera_pose``, which measures
poses."""
