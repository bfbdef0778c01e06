"""Hardware drivers: SCARA kinematics, serial codecs, transport, and the arm and tapper drivers.

This package does not depend on ROS or on the simulation. All blocking calls of a driver must come
from one thread; ``stop()`` may be called from any thread. Times are in s of the steady clock of the
transport.
"""
