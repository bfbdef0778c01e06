"""The node ``sim_world``: the simulated camera and the simulated serial devices."""
