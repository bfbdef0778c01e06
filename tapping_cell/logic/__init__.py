"""Everything that decides about motion and firing, as code without ROS, clock and threads.

A machine (``ArmLogic``, ``TapperLogic``, ``PlannerLogic``) takes events and a time and returns
effects for its host to carry out; the contract stands in ``host.py``. Two hosts run the machines:
the nodes, and the simulator in virtual time.
"""
