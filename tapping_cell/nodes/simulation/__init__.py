"""The node ``sim_world``, which simulates the camera and the serial devices."""
