"""A real HSR, or its simulation in another process, over ROS 2.

    joint states, skin ──► HSRLink ──► policy ──► HSRLink ──Guard──► trajectories, base twist

`safety` knows nothing of ROS; all else needs the wheels of the extra "ros".
"""
