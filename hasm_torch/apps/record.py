"""``hasm-record``: a LeRobot dataset from any gymnasium environment, or from arrays.

hasm-record --root=data/mine --env.id=my_lab.robot:Touched-v0 --joints='[hip, knee]' --episodes=10
hasm-record --root=data/mine --arrays=recordings.npz --joints='[hip, knee]' --fps=50
"""

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hasm_torch.apps.command_line import parse_options
from hasm_torch.data.recording import write_episodes
from hasm_torch.data.skin import SkinPatch, skin_patches
from hasm_torch.episode import Episode

PREFIX = "observation."  # of the features that further observations become
Array = NDArray[np.float32]
Controller = Callable[[Any, dict[str, Any]], Array]
Recorded = tuple[Episode, dict[str, int]]  # and the entries of each further observation


@dataclass
class EnvSource:
    """An environment to record.

    Attributes:
        id: Gymnasium id; "module:Name-v0" imports the module that registers it.
        options: Keyword arguments of the environment.
        state: Observation key of the joint positions.
        tactile: Observation key of the skin, flat or (cells, channels); empty for none.
        observations: Observation keys of what is to be bound besides, such as
            "environment_state"; each becomes the feature "observation.<key>".
        controller: "hold" asks for the joints' own positions, so that what is recorded is how the
            environment moves them; "module:function" names a function of (observation, info)
            that gives the joint targets.
    """

    id: str = ""
    options: dict[str, Any] = field(default_factory=dict)
    state: str = "state"
    tactile: str = "tactile"
    observations: list[str] = field(default_factory=list)
    controller: str = "hold"


@dataclass
class RecordConfig:
    """Options of ``hasm-record``.

    Attributes:
        root: Folder of the new dataset.
        env: An environment to record.
        arrays: In place of an environment an ``.npz`` with "state" (T, joints) and optionally
            "action" (T, joints; by default the next state), "tactile" (T, cells, channels),
            "episode" (T,) integers, and (T, entries) of each further observation to bind under
            its feature's name, "observation.environment_state" or another "observation.<name>".
        joints: Names of the joints.
        units: Unit of each joint; "rad" for all by default.
        patches: Names of skin patches that share the cells equally; by default one, "skin", or
            those of the environment's own skin.
        tactile_unit: Unit of the skin's readings.
        channels: Readings a cell, where the skin comes flat: 3 forces, 1 pressure or 6 of a wrench.
        fps: Frames a second; by default what the environment says.
        task: What is done, in words.
        episodes: Episodes to record from an environment.
        max_steps: Steps after which an episode ends at the latest.
        seed: Seed of the first episode; each further one adds 1.
        robot_type: Robot the episodes come from.
        overwrite: Replace a dataset at ``root``.
    """

    root: Path | None = None
    env: EnvSource = field(default_factory=EnvSource)
    arrays: Path | None = None
    joints: list[str] = field(default_factory=list)
    units: list[str] = field(default_factory=list)
    patches: list[str] = field(default_factory=list)
    tactile_unit: str = "N"
    channels: int = 3
    fps: int | None = None
    task: str = "move under touch"
    episodes: int = 1
    max_steps: int = 1000
    seed: int = 0
    robot_type: str = "unknown"
    overwrite: bool = False


def record(config: RecordConfig) -> Path:
    """Record a dataset.

    Args:
        config: What to record and where to.

    Returns:
        Folder of the dataset.

    Raises:
        FileExistsError: If the folder holds something already.
        FileNotFoundError: If the arrays are not there.
        ValueError: If an option is missing or does not fit what is recorded.
    """
    if config.root is None or bool(config.env.id) == (config.arrays is not None):
        raise ValueError("expected --root and either --env.id or --arrays")
    if config.arrays is not None:
        if config.fps is None:
            raise ValueError("arrays do not say how fast they were recorded: give --fps")
        return _write(config, _from_arrays(config, config.fps), config.fps, None)
    import gymnasium

    env = gymnasium.make(config.env.id, max_episode_steps=config.max_steps, **config.env.options)
    fps = config.fps or env.metadata.get("render_fps")
    if not fps:
        raise ValueError(f"{config.env.id} does not say how fast it runs: give --fps")
    if not config.joints:
        config.joints = [str(name) for name in getattr(env.unwrapped, "joints", [])]
    skin = getattr(env.unwrapped, "skin", None)
    try:
        return _write(config, _from_env(config, env, int(fps)), int(fps), skin)
    finally:
        env.close()


def _write(config: RecordConfig, episodes: Iterator[Recorded], fps: int, skin: Any) -> Path:
    found = next(episodes, None)
    if found is None:
        raise ValueError("expected at least one episode, got none")
    first, bound = found
    joints = first.state.shape[1]
    if len(config.joints) != joints:
        raise ValueError(
            f"expected a name for each of the {joints} joints, got --joints={config.joints}"
        )

    def all_episodes() -> Iterator[Episode]:
        yield first
        yield from (episode for episode, _ in episodes)

    assert config.root is not None
    return write_episodes(
        config.root,
        all_episodes(),
        joints=config.joints,
        units=config.units or ["rad"] * joints,
        skin=_patches(config, first, skin),
        fps=fps,
        robot_type=config.robot_type,
        observations={
            key: [f"{key.removeprefix(PREFIX)}_{i}" for i in range(size)]
            for key, size in bound.items()
        },
        overwrite=config.overwrite,
    )


def _patches(config: RecordConfig, first: Episode, skin: Any) -> dict[str, SkinPatch] | None:
    if first.tactile is None:
        return None
    if skin is not None and not config.patches:
        return skin_patches(skin)
    names = config.patches or ["skin"]
    cells = first.tactile.shape[1]
    share, rest = divmod(cells, len(names))
    if rest:
        raise ValueError(f"{cells} cells cannot be shared equally by the patches {names}")
    return {
        name: SkinPatch(name, slice(i * share, (i + 1) * share), unit=config.tactile_unit)
        for i, name in enumerate(names)
    }


def _from_arrays(config: RecordConfig, fps: int) -> Iterator[Recorded]:
    if config.arrays is None or not config.arrays.is_file():
        raise FileNotFoundError(f"no file {config.arrays}: expected an .npz with state (T, joints)")
    with np.load(config.arrays) as arrays:
        series = dict(sorted(arrays.items()))
    known = ("state", "action", "tactile", "episode")
    strange = [name for name in series if name not in known and not name.startswith(PREFIX)]
    if "state" not in series or strange:
        raise ValueError(
            f"{config.arrays} holds {sorted(series)}, expected state and what there is of "
            f"{', '.join(known[1:])}, {PREFIX}<name>"
        )
    lengths = {name: len(values) for name, values in series.items()}
    if len(set(lengths.values())) != 1:
        raise ValueError(f"{config.arrays}: arrays of different lengths, {lengths}")
    labels = series.pop("episode", np.zeros(len(series["state"]), dtype=int))
    borders = np.flatnonzero(np.diff(labels)) + 1
    for number, rows in enumerate(np.split(np.arange(len(labels)), borders)):
        columns = {name: values[rows] for name, values in series.items()}
        yield _episode(config, number, columns, fps)


def _from_env(config: RecordConfig, env: Any, fps: int) -> Iterator[Recorded]:
    controller, source = _controller(config.env), config.env
    named = [("state", source.state, "state")]
    if source.tactile:
        named.append(("tactile", source.tactile, "tactile"))
    named += [("observations", key, PREFIX + key) for key in source.observations]
    for number in range(config.episodes):
        observation, info = env.reset(seed=config.seed + number)
        rows: list[dict[str, Array]] = []
        over = False
        while not over and len(rows) < config.max_steps:
            for option, key, _ in named:
                if key not in observation:
                    raise ValueError(
                        f"{source.id} observes {sorted(observation)}, not {key!r}: give "
                        f"--env.{option}"
                    )
            action = np.asarray(controller(observation, info), dtype=np.float32)
            row = {column: np.array(observation[key]) for _, key, column in named}
            rows.append(row | {"action": action})
            observation, _, terminated, truncated, info = env.step(action)
            over = terminated or truncated
        columns = {column: np.stack([row[column] for row in rows]) for column in rows[0]}
        yield _episode(config, number, columns, fps)


def _controller(source: EnvSource) -> Controller:
    if source.controller == "hold":
        return lambda observation, _info: observation[source.state]
    module, _, name = source.controller.partition(":")
    if not name:
        raise ValueError(
            f'controller must be "hold" or "module:function", got {source.controller!r}'
        )
    return getattr(import_module(module), name)


def _episode(config: RecordConfig, number: int, columns: dict[str, Array], fps: int) -> Recorded:
    state, tactile = columns["state"], columns.get("tactile")
    action = columns.get("action", np.concatenate([state[1:], state[-1:]]))  # the next state
    if tactile is not None and tactile.ndim != 3:
        if tactile.ndim != 2 or tactile.shape[1] % config.channels:
            raise ValueError(
                f"expected tactile (T, cells, channels), or flat with {config.channels} channels a "
                f"cell (--channels), got {tactile.shape}"
            )
        tactile = tactile.reshape(len(tactile), -1, config.channels)
    further = {
        name: values.reshape(len(state), -1)
        for name, values in columns.items()
        if name.startswith(PREFIX)
    }
    bound = np.concatenate(list(further.values()), axis=1) if further else None
    time = np.arange(len(state)) / fps
    sizes = {name: values.shape[1] for name, values in further.items()}
    return Episode(number, config.task, time, state, action, tactile, bound), sizes


def main() -> None:
    """Record with the options of the command line."""
    try:
        root = record(parse_options(RecordConfig))
    except (FileExistsError, FileNotFoundError, ValueError) as error:
        sys.exit(f"hasm-record: {error}")
    print(f"recorded {root}; train on it with: uv run train.py --dataset.root={root}")


if __name__ == "__main__":
    main()
