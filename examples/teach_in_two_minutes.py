"""An empty robot is taught in under two minutes: to yield to pushes, to forget, and to grasp.

    uv run examples/teach_in_two_minutes.py

Simulated hands do what a person does on the page: they push the wrist, lead the untouched robot to
another posture, and push again. Each of eight lessons is learned as soon as it ends. Then 100
pushes that were never shown are compared with the hand's own law; one lesson is forgotten; and a
grasp is taught once, to an empty robot, and repeated from five other starts. The figures go to
benchmarks/results/teach_in_two_minutes.json, a video to docs/.
"""

import json
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hasm_torch import HASM, Body, HASMConfig
from hasm_torch.apps.command_line import parse_options
from hasm_torch.episode import Episode
from hasm_torch.evaluation import along_force, yielding
from hasm_torch.evaluation.grasp import GraspCase
from hasm_torch.evaluation.rollout import Policy, run_case
from hasm_torch.evaluation.video import Frame, caption, write_video
from hasm_torch.sim.demonstrator import Recorder, grasp_episodes, push
from hasm_torch.sim.env import CONTROL_RATE, HSRTouchEnv
from hasm_torch.sim.tasks import WRIST_PATCHES, YIELD_WRIST, random_posture
from hasm_torch.sim.teacher import YieldTeacher
from hasm_torch.touch.simulated import body_in

# Between pushes a hand leads the robot about, so that its motion alone does not tell that touch
# is what moves it.
TAUGHT_BY_TOUCH = HASMConfig(drive="spike")
REST = 0.1  # s before the first push
GRASP_FORCE, GRASP_STARTS = 9.0, 5
FILMED, EVERY = 6, 2  # pushes in the video, and control steps a picture


@dataclass
class Options:
    """Options of the command line.

    Attributes:
        lessons: Lessons taught.
        postures: Postures in which the wrist is pushed in a lesson.
        pushes: Pushes in each posture, on different patches in turn.
        tested: Unseen pushes.
        seed: Seed of the hands; tests have another.
        render: Whether the video is made.
        output: JSON to write.
        video: MP4 to write.
    """

    lessons: int = 8
    postures: int = 3
    pushes: int = 4
    tested: int = 100
    seed: int = 0
    render: bool = True
    output: Path = Path("benchmarks/results/teach_in_two_minutes.json")
    video: Path = Path("docs/teach_in_two_minutes.mp4")


def lesson(
    env: HSRTouchEnv, options: Options, number: int, generator: np.random.Generator
) -> Episode:
    """One recording: pushes in some postures, to which the robot is led."""
    teacher = YieldTeacher(env)
    recorder: Recorder | None = None
    patch = number * options.postures * options.pushes  # single pushes go round the wrist too
    for _ in range(options.postures):
        posture = random_posture(env.joint_lower, env.joint_upper, generator)
        if recorder is None:
            recorder = Recorder(teacher, posture)
            recorder.steps(REST)
        else:
            recorder.lead(posture)
        for _ in range(options.pushes):
            push(recorder, teacher, WRIST_PATCHES[patch % len(WRIST_PATCHES)], generator)
            recorder.steps(REST)
            patch += 1
    assert recorder is not None
    return recorder.episode(number, YIELD_WRIST)


def taught(model: HASM, episodes: list[Episode]) -> list[float]:
    """Learn episodes one after the other; the seconds each took."""
    seconds = []
    for episode in episodes:
        begin = time.perf_counter()
        model.learn(episode)
        seconds.append(time.perf_counter() - begin)
    return seconds


def tested(
    env: HSRTouchEnv, models: dict[str, HASM], options: Options
) -> dict[str, dict[str, Any]]:
    """Unseen pushes from unseen postures, beside the hand's own law on the same pushes."""
    planned = yielding.cases(options.tested, options.seed + 1000, kinds=("even",))
    cases = [case.without_rest() for case in planned]

    def motions(policy: Policy) -> list[along_force.Motion]:
        return [run_case(case, env, policy)[1]["motion"] for case in cases]

    own = motions(YieldTeacher(env))
    return {name: along_force.summarise(motions(model), own) for name, model in models.items()}


def controls(model: HASM, episodes: list[Episode], body: Body) -> dict[str, HASM]:
    """The same lessons with a part of the method replaced by something simpler."""
    without = {
        "RoPE3D off": replace(TAUGHT_BY_TOUCH, rope=False, touch="direction"),
        "the patch alone": replace(TAUGHT_BY_TOUCH, touch="patch", value="displacement"),
    }
    others = {name: HASM(config, body) for name, config in without.items()}
    for other in others.values():
        taught(other, episodes)
    both_ends = {"argmax": model.with_beta(float("inf")), "mean of all": model.with_beta(0.0)}
    return both_ends | others


def forgotten(model: HASM, episodes: list[Episode], body: Body) -> dict[str, Any]:
    """What one lesson does to a touch in its own posture, before and after it is forgotten."""
    number, shown = model.episodes[0].number, episodes[0]
    tactile = np.asarray(shown.tactile)
    touched = int(np.abs(tactile).sum(axis=(1, 2)).argmax())

    def weight() -> float:
        model.reset()
        for t in range(touched + 1):
            model.step(torch.from_numpy(shown.state[t]), torch.from_numpy(tactile[t]))
        return sum(why.episodes.get(number, 0.0) for why in model.explain())

    before = weight()
    model.forget(number)
    after = weight()
    without = HASM(TAUGHT_BY_TOUCH, body)
    taught(without, episodes[1:])
    rows = [sum(known.associations for known in each.episodes) for each in (model, without)]
    return {"weight_before": before, "weight_after": after, "rows_as_if_never_learned": rows}


def grasped(seed: int) -> tuple[dict[str, Any], HASM]:
    """A grasp taught once to an empty robot and repeated from other starts."""
    generator = np.random.default_rng(seed)
    (shown,) = grasp_episodes(generator, [(0.0, 0.0)])
    model = HASM(TAUGHT_BY_TOUCH, body_in("grasp"))
    seconds = taught(model, [shown])
    env = HSRTouchEnv("grasp")
    cases = [
        GraspCase(seed + 1 + i, GRASP_FORCE, (0.0, 0.0), pauses=1) for i in range(GRASP_STARTS)
    ]
    lifted = [bool(run_case(case, env, model)[1]["success"]) for case in cases]
    env.close()
    taught_in = len(shown) / CONTROL_RATE
    figures = {"taught_s": taught_in, "learned_s": seconds[0], "starts": len(lifted)}
    return figures | {"lifted": sum(lifted)}, model


def filmed(pushed: HASM, grasping: HASM, options: Options) -> Path:
    """A video of unseen pushes and of the grasp repeated."""
    planned = yielding.cases(FILMED, options.seed + 1000, kinds=("even",))
    clips: list[tuple[str, HASM, Any, str]] = [
        ("compliance", pushed, case.without_rest(), "unseen push") for case in planned
    ]
    repeated = GraspCase(options.seed + 1, GRASP_FORCE, (0.0, 0.0), pauses=0)
    clips.append(("grasp", grasping, repeated, "grasp shown once, from another start"))
    frames = []
    for scene, model, case, title in clips:
        env = HSRTouchEnv(scene, render_mode="rgb_array")
        seen: list[Frame] = []

        def watch(env: HSRTouchEnv = env, seen: list[Frame] = seen) -> None:
            seen.append(np.asarray(env.render()))

        trace, _ = run_case(case, env, model, watch)
        for i in range(0, len(seen), EVERY):
            force = f"{trace.patch[i, 0]}  {trace.strength[i]:.1f} N" if trace.patch[i, 0] else ""
            frames.append(caption(seen[i], f"{title}   {force}"))
        env.close()
    path = options.video
    path.parent.mkdir(parents=True, exist_ok=True)
    write_video(path, frames, CONTROL_RATE // EVERY)
    return path


def main() -> None:
    """Run the session and write its figures."""
    options = parse_options(Options)
    env = HSRTouchEnv("compliance")
    generator = np.random.default_rng(options.seed)
    episodes = [lesson(env, options, number, generator) for number in range(options.lessons)]
    body = body_in("compliance")
    taught(HASM(TAUGHT_BY_TOUCH, body), episodes[:2])  # compiles the kernels, once a machine
    model = HASM(TAUGHT_BY_TOUCH, body)
    seconds = taught(model, episodes)
    figures: dict[str, Any] = {
        "lessons": options.lessons,
        "pushes": options.lessons * options.postures * options.pushes,
        "taught_s": sum(len(episode) for episode in episodes) / CONTROL_RATE,
        "learned_s": sum(seconds),
        "tested": tested(env, {"memory": model} | controls(model, episodes, body), options),
        "forgotten": forgotten(model, episodes, body),
    }
    figures["grasp"], grasping = grasped(options.seed)
    env.close()
    if options.render:
        taught(model, episodes[:1])  # again, after it was forgotten
        print(filmed(model, grasping, options))
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(json.dumps(figures, indent=2) + "\n")
    shares = {name: found["share_07_of_teacher"] for name, found in figures["tested"].items()}
    share, grasp, gone = shares.pop("memory"), figures["grasp"], figures["forgotten"]
    print(
        f"{figures['pushes']} pushes in {options.lessons} lessons, {figures['taught_s']:.0f} s of "
        f"teaching, learned in {figures['learned_s']:.2f} s\n"
        f"{options.tested} unseen pushes: {share:.0%} of the hand's own share go with the force "
        f"(cos > {along_force.ALONG}); with parts replaced: "
        f"{', '.join(f'{name} {other:.0%}' for name, other in shares.items())}\n"
        f"weight of the first lesson in its own posture: {gone['weight_before']:.2f}, after "
        f"forgetting it {gone['weight_after']:.2f}\n"
        f"a grasp shown once ({grasp['taught_s']:.0f} s) and repeated from {grasp['starts']} other "
        f"starts: lifted {grasp['lifted']} times\n{options.output}"
    )


if __name__ == "__main__":
    main()
