"""State machines that decide on motion and firing. Their code uses no ROS, clocks or threads.

A machine (``ArmLogic``, ``TapperLogic``, ``PlannerLogic``) receives events with a time and returns
effects for its host to execute; ``host.py`` defines the interface. Two kinds of host run the
machines: the nodes, and the simulator in virtual time.
"""
