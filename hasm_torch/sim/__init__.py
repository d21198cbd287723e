"""Simulation of the touched HSR: importing this registers "hasm_torch/HSRTouch-v0"."""

from hasm_torch._extras import require

require("sim")

import gymnasium as gym  # noqa: E402

from hasm_torch.sim.env import MAX_EPISODE_STEPS, HSRTouchEnv  # noqa: E402

__all__ = ["HSRTouchEnv"]

gym.register(
    id="hasm_torch/HSRTouch-v0",
    entry_point="hasm_torch.sim.env:HSRTouchEnv",
    max_episode_steps=MAX_EPISODE_STEPS,
)
