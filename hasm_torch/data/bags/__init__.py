"""Recordings of ROS 1, ROS 2 and MCAP as episodes: reading, pairing, joints and skins."""
