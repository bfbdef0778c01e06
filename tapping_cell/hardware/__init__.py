"""The devices: SCARA kinematics, serial codecs, transport, the arm's and the tapper's drivers.

Nothing here knows ROS or simulation. Blocking calls belong to one worker thread; ``stop()`` may be
called from any thread. Time is the transport's steady clock, in s.
"""
