"""Teaching by hand in a browser: push the simulated HSR, show it something, see why it moves.

page ──commands──► Session (50 Hz) ──► HSRTouchEnv
▲                   │   ▲
└──── Snapshot ◄────┘   └── Learner (a thread of its own) ──► Shelf (files)
"""

from hasm_torch._extras import require

require("touch")
