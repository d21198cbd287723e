"""What LeRobot's command lines find: the policy ``hasm`` and the environment ``hsr_touch``."""
