"""LeRobot's policy "hasm": the memory behind the interface that LeRobot trains and rolls out.

    batch ──episode_index──► episodes shown so far ──read whole, in order──► HASM.fit
    state, skin, what else is bound ──HASM.step, one rollout a robot──► action

Whichever way a model was trained, `checkpoint` says how it lies on disk.
"""

import hashlib
import logging
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from torch import Tensor, nn

from hasm_torch.data.body import body_of
from hasm_torch.data.episodes import EpisodeSet, FeatureMap, load_episodes
from hasm_torch.episode import STATE, TACTILE, Episode
from hasm_torch.lerobot.configuration_hasm import HASMConfig
from hasm_torch.model import checkpoint
from hasm_torch.model.control import Rollout
from hasm_torch.model.hasm import HASM

if TYPE_CHECKING:
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

# In training the memory is built anew when this many times the episodes that it holds were shown.
GROWTH = 1.5
MEASURED = 8  # frames of an episode that are predicted for the loss, evenly spread


class HASMPolicy(PreTrainedPolicy):
    """The memory as a LeRobot policy.

    Training stores an episode once a batch shows a frame of it, whichever frames and however
    often: the memory is built anew from all episodes shown so far, read from the dataset in
    their order. So each sample is stored once, on every process alike, held-out episodes stay
    out, and one pass over the data stores all of it. While training goes on it is built anew as
    the episodes shown become half as many again; before it is used or saved, from all of them.

    Args:
        config: Configuration; training fills in the body and what was settled.
        dataset_meta: The dataset to learn; not needed to roll out a checkpoint.
        **kwargs: What LeRobot also offers to policies; unused.

    Raises:
        ValueError: If neither dataset nor checkpoint says what the body is, or the two differ.
    """

    config_class = HASMConfig
    name = "hasm"
    config: HASMConfig

    def __init__(
        self,
        config: HASMConfig,
        dataset_meta: "LeRobotDatasetMetadata | None" = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(config)
        self._data: EpisodeSet | None = None
        if dataset_meta is not None:
            self._data = self._open(dataset_meta.root)
        if config.body is None:
            raise ValueError(
                "policy hasm needs a dataset to learn (lerobot-train --dataset.root=...) or a "
                "checkpoint (--policy.path=...), got neither"
            )
        config.validate_features()
        self.model = HASM(config.model, config.body, config.settled)
        # Optimizers, backward and data-parallel training want a parameter; this one does nothing.
        self.anchor = nn.Parameter(torch.zeros(()))
        self._errors: dict[int, float] = {}  # of the prediction of every episode met
        self._shown = list(config.episodes)
        self.reset()

    def get_optim_params(self) -> Any:
        """The one parameter, which no step changes."""
        return self.parameters()

    def reset(self) -> None:
        """Forget the rollouts; the next batch of observations begins new ones."""
        self._rollouts: list[Rollout] = []

    def train(self, mode: bool = True) -> "HASMPolicy":
        """As in PyTorch; where training ends, the memory takes in all episodes shown."""
        if not mode:
            self._learn(self._shown)
        return super().train(mode)

    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """One control step of every robot in the batch; each goes on with its own rollout.

        Args:
            batch: "observation.state" (B, joints), rad or m; "observation.tactile" (B, readings)
                where the robot has a skin; every further observation that is bound (B, entries).
            **kwargs: What LeRobot also offers to policies; unused.

        Returns:
            (B, joints) joint targets, rad or m, in the order of the action.

        Raises:
            ValueError: If a shape is off, or B changes without a ``reset``.
            RuntimeError: If nothing was learned.
        """
        body, states = self.model.body, batch[STATE]
        skins = batch[TACTILE] if body.channels else [None] * len(states)
        bound = [batch[name].flatten(1) for name in body.observations]
        seen = torch.cat(bound, dim=1) if bound else [None] * len(states)
        if not self._rollouts:
            self._rollouts = [self.model.new_rollout() for _ in states]
        if len(states) != len(self._rollouts):
            raise ValueError(
                f"expected observations of {len(self._rollouts)} robots as before, got "
                f"{len(states)}; call reset() first"
            )
        steps = zip(states, skins, self._rollouts, seen, strict=True)
        targets = torch.stack([self.model.step(*step) for step in steps])
        order = [body.joints.index(name) for name in body.targets]
        return targets[:, order] if order else targets

    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """``select_action`` as a chunk of one, (B, 1, joints): touch decides the next one."""
        return self.select_action(batch).unsqueeze(1)

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, Any]]:
        """Store the episodes that a training batch shows, then predict them.

        Args:
            batch: Frames of the dataset, with "episode_index".

        Returns:
            Loss: mean error of what is predicted of the batch's episodes, the method's ``horizon``
            ahead, rad or m; and the numbers of episodes and associations held.

        Raises:
            RuntimeError: If the policy was built without a dataset, or nothing was learned yet.
        """
        if self._data is None:
            raise RuntimeError("forward needs the dataset: build the policy with dataset_meta")
        if self.training:
            self._shown = self._met(batch["episode_index"])
            if len(self._shown) >= GROWTH * len(self.config.episodes):
                self._learn(self._shown)
        if self.config.settled is None:
            raise RuntimeError("nothing was learned yet, so there is nothing to recall")
        episodes = set(batch["episode_index"].flatten().tolist())
        error = np.mean([self._error(self._data.episodes[index]) for index in episodes])
        loss = float(error) + 0.0 * self.anchor
        stored = self.config.settled.capacity
        return loss, {"episodes": len(self.config.episodes), "associations": stored}

    def _open(self, root: Path) -> EpisodeSet:
        """Read the dataset and note in the configuration what it is."""
        config, data = self.config, load_episodes(root, FeatureMap(bound=self.config.bound))
        body = body_of(data)
        if config.body not in (None, body):
            theirs, ours = asdict(config.body), asdict(body)
            differ = ", ".join(name for name in ours if ours[name] != theirs[name])
            raise ValueError(
                f"the checkpoint {config.pretrained_path} is of another body than dataset {root} "
                f"({differ} differ): train without --policy.path, or with this body's episodes"
            )
        content = b"".join((root / "meta" / n).read_bytes() for n in ("info.json", "stats.json"))
        fingerprint = hashlib.sha256(content).hexdigest()
        if config.dataset != fingerprint:
            if config.episodes:
                logging.warning("The memory held another dataset; %s takes its place.", root)
            config.dataset, config.episodes = fingerprint, []
        config.body = body
        return data

    def _met(self, indices: Tensor) -> list[int]:
        """Episodes shown so far to any of the processes, with those of a batch."""
        shown = torch.zeros(len(self._data or ()), dtype=torch.uint8, device=self.anchor.device)
        shown[self._shown] = 1
        shown[indices.flatten()] = 1
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            torch.distributed.all_reduce(shown, torch.distributed.ReduceOp.MAX)
        return torch.nonzero(shown).flatten().tolist()

    @torch.inference_mode(False)
    def _learn(self, episodes: list[int]) -> None:
        """Build the memory anew from these episodes, unless it holds them already."""
        if self._data is None or episodes == self.config.episodes:
            return
        self.model.cpu().fit(self._data.episodes[index] for index in episodes)
        self.model.to(self.anchor.device)
        self.config.episodes, self.config.settled = episodes, self.model.settled
        self._errors.clear()
        self.reset()

    def _error(self, episode: Episode) -> float:
        if episode.index not in self._errors:
            ahead = self.config.model.horizon
            moved, frames = self.model.predict(episode, ahead, MEASURED)
            wrong = moved - (episode.state[frames + ahead] - episode.state[frames])
            self._errors[episode.index] = float(np.abs(wrong).mean()) if len(frames) else 0.0
        return self._errors[episode.index]

    def _save_pretrained(
        self, save_directory: Path, state_dict: dict[str, Tensor] | None = None
    ) -> None:
        # The memory is made of buffers, whole on every process: a gathered state dict adds nothing.
        self._learn(self._shown)
        if self.config.settled is None:
            raise RuntimeError("nothing to save: the policy has learned nothing yet")
        self.config._save_pretrained(save_directory)
        checkpoint.save_weights(self.model.state_dict(), save_directory)

    @classmethod
    def _load_as_safetensor(
        cls, model: "HASMPolicy", model_file: str, map_location: str, strict: bool
    ) -> "HASMPolicy":
        # Always strict: a memory that is empty or partly loaded would hold the robot still.
        if model.config.settled is None:
            raise ValueError(
                f"checkpoint {Path(model_file).parent} holds no memory: train it first"
            )
        checkpoint.load_weights(model.model, Path(model_file).parent)
        return model
