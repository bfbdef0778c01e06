"""Hardware drivers: SCARA kinematics, serial codecs, transport, and the arm and tapper drivers.

This package does not depend on ROS or on the simulation. Blocking calls belong to one worker
thread; ``stop()`` may be called from any thread. Times are those of the transport's steady clock,
in s.
"""
