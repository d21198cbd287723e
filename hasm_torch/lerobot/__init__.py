"""What LeRobot's command lines find: the policy ``hasm`` and the environment ``hsr_touch``."""

from hasm_torch._extras import require

require("lerobot")
