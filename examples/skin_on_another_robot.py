"""Skin on a robot that is not ours: a Franka arm gets 164 cells and is taught to yield.

    uv pip install gymnasium-robotics      # ships the arm's MJCF and meshes
    uv run examples/skin_on_another_robot.py

The forearm is covered from four sides, a finger pushes it in random postures while the joints move
by the admittance law v = k F, and the memory learns these episodes: the code of the HSR, none of it
written for this arm. Then pushes that were never shown, of random forces on random cells, are
compared with the law's own. The figures go to benchmarks/results/another_robot.json, a video to
docs/.
"""

import json
import sys
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from hasm_torch import HASM, Body, HASMConfig
from hasm_torch.apps.command_line import parse_options
from hasm_torch.episode import Episode
from hasm_torch.evaluation import along_force
from hasm_torch.evaluation.push import Push
from hasm_torch.evaluation.rollout import Policy, roll_out
from hasm_torch.evaluation.video import Frame, caption, write_video
from hasm_torch.sim.any_robot import STANDING, SkinnedRobot, body_of_robot
from hasm_torch.sim.demonstrator import pushed_in_turn
from hasm_torch.sim.patch import Patch
from hasm_torch.sim.render import View
from hasm_torch.sim.tasks import POSTURE_MARGIN, TEST_FORCES
from hasm_torch.sim.teacher import YieldTeacher
from hasm_torch.sim.touch_env import CONTROL_RATE

Array = NDArray[np.float64]

JOINTS = tuple(f"robot:panda0_joint{number}" for number in range(1, 8))
SPEED = (2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61)  # rad/s, of the maker's data sheet
HOME = (0.0, 0.2, 0.0, -1.9, 0.0, 0.6, 0.8)  # rad, the forearm before the robot
LED = JOINTS[:5]  # those that move the forearm
FOREARM = "panda0_link5"
PATCHES = [
    Patch("front", FOREARM, toward=[0.0, 1.0, 0.0]),
    Patch("back", FOREARM, toward=[0.0, -1.0, 0.0]),
    Patch("left", FOREARM, toward=[1.0, 0.0, 0.0]),
    Patch("right", FOREARM, toward=[-1.0, 0.0, 0.0]),
]
TASK = "yield to pushes on the forearm"
PUSH_SECONDS = 1.2  # of an unseen push
FILMED, FILMED_FORCE, FILMED_SECONDS = 6, 8.0, 1.6  # pushes in the video, N, s
EVERY = 2  # control steps a picture
LOOK_AT, DISTANCE, ELEVATION = (0.2, 0.0, 0.45), 1.7, -15.0  # m, m, degrees
ASIDE = 115.0  # degrees from where a cell looks to where the camera does: the finger stays in view
GREY = [0.72, 0.74, 0.77, 1.0]  # so that fingers and cells stand out


@dataclass
class Options:
    """Options of the command line.

    Attributes:
        demonstrations: Episodes, in each of which every patch is pushed once.
        tested: Unseen pushes.
        share: Of each joint's range around the usual posture that postures take, 1 is all of it.
        seed: Seed of the hands; tests have another.
        render: Whether the video is made.
        output: JSON to write.
        video: MP4 to write.
    """

    demonstrations: int = 40
    tested: int = 80
    share: float = 0.5
    seed: int = 0
    render: bool = True
    output: Path = Path("benchmarks/results/another_robot.json")
    video: Path = Path("docs/another_robot.mp4")


@dataclass(frozen=True)
class Case:
    """An unseen push: where the robot starts, rad, and what the finger does, N."""

    start: Array
    patch: str
    cell: int
    force: float


class Still:
    """Stays where it begins."""

    def reset(self) -> None:
        """Start a new rollout."""
        self._start: Tensor | None = None

    def step(self, state: Tensor, skin: Tensor, *, observation: Tensor | None = None) -> Tensor:
        """The first state."""
        self._start = state if self._start is None else self._start
        return self._start


def franka() -> mujoco.MjSpec:
    """The arm that gymnasium-robotics ships."""
    package = find_spec("gymnasium_robotics")
    if package is None or package.origin is None:
        sys.exit("the arm's files are missing: uv pip install gymnasium-robotics")
    folder = Path(package.origin).parent / "envs/assets/kitchen_franka/franka_assets"
    spec = mujoco.MjSpec.from_string(
        f"""<mujoco>
          <include file="{folder / "assets.xml"}"/>
          <compiler meshdir="{folder / "meshes"}"/>
          <worldbody><include file="{folder / "chain.xml"}"/></worldbody>
        </mujoco>"""
    )
    for geom in spec.geoms:
        geom.rgba = GREY
    return spec


def skinned(view: View = STANDING, render_mode: str | None = None) -> SkinnedRobot:
    """The arm with skin on its forearm."""
    return SkinnedRobot(franka(), PATCHES, JOINTS, SPEED, HOME, view, render_mode)


def posture(env: SkinnedRobot, share: float, generator: np.random.Generator) -> Array:
    """Every joint anywhere in a share of its range around the usual posture."""
    reach = share * (env.joint_upper - env.joint_lower) / 2
    drawn = env.home + generator.uniform(-reach, reach)
    return np.clip(drawn, env.joint_lower + POSTURE_MARGIN, env.joint_upper - POSTURE_MARGIN)


def demonstrated(env: SkinnedRobot, teacher: YieldTeacher, options: Options) -> list[Episode]:
    """Episodes in which every patch is pushed in a random posture."""
    rng = np.random.default_rng(options.seed)
    return [
        pushed_in_turn(teacher, posture(env, options.share, rng), env.skin.patches, rng, i, TASK)
        for i in tqdm(range(options.demonstrations), desc="pushed")
    ]


def planned(env: SkinnedRobot, options: Options, count: int) -> list[Case]:
    """Unseen pushes."""
    rng = np.random.default_rng(options.seed + 1000)
    cases = []
    for _ in range(count):
        patch = str(rng.choice(env.skin.patches))
        cells = env.skin.slices[patch]
        cell = int(rng.integers(cells.stop - cells.start))
        start = posture(env, options.share, rng)
        cases.append(Case(start, patch, cell, float(rng.uniform(*TEST_FORCES))))
    return cases


def controls(model: HASM, episodes: list[Episode], body: Body) -> dict[str, Policy]:
    """The same episodes with a part of the method replaced; "mean" has no first-order read-out."""
    mean = HASMConfig(touch="direction", readout="mean")
    up = replace(body, normals=[[0.0, 0.0, 1.0]] * sum(body.cells), chains={})
    made = {
        "mean": HASM(mean, body),
        "mean, RoPE3D off": HASM(replace(mean, rope=False), body),
        "mean, one direction for all touches": HASM(mean, up),
        "mean, a direction a patch, in the link": HASM(
            replace(mean, touch="patch", value="displacement"), body
        ),
        "RoPE3D off": HASM(HASMConfig(touch="direction", rope=False), body),
    }
    for control in tqdm(made.values(), desc="controls"):
        control.fit(episodes)
    return {"argmax": model.with_beta(float("inf")), **made, "standing still": Still()}


def tested(
    env: SkinnedRobot, policies: dict[str, Policy], teacher: YieldTeacher, cases: list[Case]
) -> dict[str, dict[str, Any]]:
    """Where the pushed point goes, beside the law's own on the same pushes."""

    def motions(policy: Policy) -> list[along_force.Motion]:
        pushes = [Push({c.patch: (c.force, c.cell)}, 0.0, PUSH_SECONDS) for c in cases]
        rollouts = zip(cases, pushes)
        return [along_force.motion(roll_out(env, policy, p, c.start, 0)) for c, p in rollouts]

    own = motions(teacher)
    found = {"the law": along_force.summarise(own, own)}
    for name, policy in tqdm(policies.items(), desc="tested"):
        found[name] = along_force.summarise(motions(policy), own)
    return found


def filmed(model: HASM, options: Options) -> Path:
    """A video of unseen pushes, each seen from the side."""
    env = skinned()
    frames: list[Frame] = []
    for case in planned(env, options, FILMED):
        env.reset(options={"joints": case.start})
        normal = env.skin.normals[env.skin.slices[case.patch]][case.cell].numpy()
        x, y, _ = env.data.body(FOREARM).xmat.reshape(3, 3) @ normal
        view = View(LOOK_AT, DISTANCE, float(np.degrees(np.arctan2(y, x))) + ASIDE, ELEVATION)
        stage = skinned(view, "rgb_array")
        seen: list[Frame] = []

        def watch(stage: SkinnedRobot = stage, seen: list[Frame] = seen) -> None:
            seen.append(np.asarray(stage.render()))

        push = Push({case.patch: (FILMED_FORCE, case.cell)}, 0.0, FILMED_SECONDS)
        trace = roll_out(stage, model, push, case.start, 0, watch=watch)
        for i in range(0, len(seen), EVERY):
            text = f"unseen push   {case.patch}, cell {case.cell}   {trace.strength[i]:.1f} N"
            frames.append(caption(seen[i], text))
        stage.close()
    options.video.parent.mkdir(parents=True, exist_ok=True)
    write_video(options.video, frames, CONTROL_RATE // EVERY)
    return options.video


def main() -> None:
    """Teach, test, film."""
    options = parse_options(Options)
    env = skinned()
    teacher = YieldTeacher(env, dict.fromkeys(env.skin.patches, LED))
    body = body_of_robot(env)
    episodes = demonstrated(env, teacher, options)
    model = HASM(HASMConfig(), body)
    report = model.fit(episodes)
    policies: dict[str, Policy] = {"memory": model, **controls(model, episodes, body)}
    figures = tested(env, policies, teacher, planned(env, options, options.tested))
    env.close()
    options.output.parent.mkdir(parents=True, exist_ok=True)
    result = {
        "robot": "Franka arm of gymnasium-robotics",
        "cells": env.skin.cells,
        "demonstrations": options.demonstrations,
        "taught_s": sum(len(episode) for episode in episodes) / CONTROL_RATE,
        "share_of_joint_ranges": options.share,
        "tested": figures,
    }
    options.output.write_text(json.dumps(result, indent=2) + "\n")
    if options.render:
        print(filmed(model, options))
    print(f"{report}\n{env.skin.cells} cells, {result['taught_s']:.0f} s of teaching")
    print(f"{options.tested} unseen pushes, share with the force (cos > {along_force.ALONG}):")
    print(f"  {'the law':40} {figures.pop('the law')['share_07']:.2f}")
    for name, found in figures.items():
        print(f"  {name:40} {found['share_07_of_teacher']:.2f} of the law's")
    print(options.output)


if __name__ == "__main__":
    main()
