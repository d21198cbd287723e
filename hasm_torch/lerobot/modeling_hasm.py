"""LeRobot's policy "hasm": the memory behind the interface that LeRobot trains and rolls out.

    batch ──episode_index──► episodes shown so far ──read whole, in order──► HASM.fit
    observation.state, observation.tactile ──HASM.step, one rollout a robot──► action

Whichever way a model was trained, `checkpoint` says how it lies on disk.
"""

import hashlib
import logging
from dataclasses import asdict
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from torch import Tensor, nn

from hasm_torch.data.body import body_of
from hasm_torch.data.episodes import EpisodeSet, load_episodes
from hasm_torch.lerobot.configuration_hasm import HASMConfig
from hasm_torch.model import checkpoint
from hasm_torch.model.checkpoint import ACTION, STATE, TACTILE
from hasm_torch.model.control import Rollout
from hasm_torch.model.hasm import HASM
from hasm_torch.model.learning import spike_series

if TYPE_CHECKING:
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata


class HASMPolicy(PreTrainedPolicy):
    """The memory as a LeRobot policy.

    Training stores an episode once a batch shows a frame of it, whichever frames and however
    often: the memories are built anew from all episodes shown so far, read from the dataset in
    their order. So each sample is stored once, on every process alike, held-out episodes stay
    out, and one pass over the data stores all of it.

    Args:
        config: Configuration; training fills in the body and the memories.
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
        self.model = HASM(config.model, config.body, config.memories)
        # Optimizers, backward and data-parallel training want a parameter; this one does nothing.
        self.anchor = nn.Parameter(torch.zeros(()))
        # Of every episode met: where it begins in the dataset, and what its skin felt.
        lengths = [len(episode) for episode in self._data or ()]
        self._starts = list(accumulate(lengths, initial=0))
        self._series: dict[int, tuple[Tensor, Tensor]] = {}
        self.reset()

    def get_optim_params(self) -> Any:
        """The one parameter, which no step changes."""
        return self.parameters()

    def reset(self) -> None:
        """Forget the rollouts; the next batch of observations begins new ones."""
        self._rollouts: list[Rollout] = []

    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """One control step of every robot in the batch; each goes on with its own rollout.

        Args:
            batch: "observation.state" (B, joints), rad or m; "observation.tactile" (B, points), N.
            **kwargs: What LeRobot also offers to policies; unused.

        Returns:
            (B, joints) joint targets, rad or m.

        Raises:
            ValueError: If a shape is off, or B changes without a ``reset``.
            RuntimeError: If nothing was learned.
        """
        states, skins = batch[STATE], batch[TACTILE]
        if not self._rollouts:
            self._rollouts = [self.model.new_rollout() for _ in states]
        if len(states) != len(self._rollouts):
            raise ValueError(
                f"expected observations of {len(self._rollouts)} robots as before, got "
                f"{len(states)}; call reset() first"
            )
        steps = zip(states, skins, self._rollouts, strict=True)
        return torch.stack([self.model.step(*step) for step in steps])

    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """``select_action`` as a chunk of one, (B, 1, joints): touch decides the next one."""
        return self.select_action(batch).unsqueeze(1)

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, Any]]:
        """Store the episodes that a training batch shows, then recall at its frames.

        Args:
            batch: Frames of the dataset, with "episode_index" and "index".

        Returns:
            Loss: mean distance between recalled and recorded joint targets, rad or m, over the
            frames that feel a touch; and the numbers of episodes and associations held.

        Raises:
            RuntimeError: If the policy was built without a dataset, or nothing was learned yet.
        """
        if self._data is None:
            raise RuntimeError("forward needs the dataset: build the policy with dataset_meta")
        if self.training:
            self._learn(self._data, batch["episode_index"])
        loss = self._recall_error(self._data, batch) + 0.0 * self.anchor
        stored = sum(shape.capacity for shape in self.model.shapes.values())
        return loss, {"episodes": len(self.config.episodes), "associations": stored}

    def _open(self, root: Path) -> EpisodeSet:
        """Read the dataset and note in the configuration what it is."""
        config, data = self.config, load_episodes(root)
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
                logging.warning("The memories held another dataset; %s takes its place.", root)
            config.dataset, config.episodes = fingerprint, []
        config.body = body
        return data

    @torch.no_grad()
    def _learn(self, data: EpisodeSet, indices: Tensor) -> None:
        """Build the memories anew if the batch shows an episode that they do not hold."""
        shown = torch.zeros(len(data), dtype=torch.uint8, device=self.anchor.device)
        shown[self.config.episodes] = 1
        shown[indices.flatten()] = 1
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            torch.distributed.all_reduce(shown, torch.distributed.ReduceOp.MAX)
        episodes = torch.nonzero(shown).flatten().tolist()
        if episodes == self.config.episodes:
            return
        self.model.cpu().fit(data.episodes[index] for index in episodes)
        self.model.to(self.anchor.device)
        self.config.episodes, self.config.memories = episodes, dict(self.model.shapes)
        self.reset()

    @torch.no_grad()
    def _recall_error(self, data: EpisodeSet, batch: dict[str, Tensor]) -> Tensor:
        if not self.model.memories:
            raise RuntimeError("nothing was learned yet, so there is nothing to recall")
        errors = []
        spikes, density = self._felt(data, batch)
        for patch in self.model.patches:
            memory, index = self.model.memory(patch), self.model.body.patches.index(patch)
            rows = torch.nonzero(spikes[:, index] > 0).flatten()
            state, action = batch[STATE][rows], batch[ACTION][rows]
            link = self.model.link_rotation(patch, state)
            recalled, _ = memory(state[:, memory.joints], density[rows, index], link, patch)
            errors.append((recalled - action[:, memory.joints]).abs().flatten())
        found = torch.cat(errors)
        return found.mean() if len(found) else self.anchor.new_zeros(())

    def _felt(self, data: EpisodeSet, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Spikes and rate densities of the batch's frames, (B, patches) each."""
        rows = []
        episodes, frames = batch["episode_index"].flatten(), batch["index"].flatten()
        for episode, frame in zip(episodes.tolist(), frames.tolist(), strict=True):
            if episode not in self._series:
                skin = torch.as_tensor(data.episodes[episode].tactile).to(self.model.lower)
                self._series[episode] = spike_series(self.model, skin)
            spikes, density = self._series[episode]
            row = frame - self._starts[episode]
            rows.append((spikes[row], density[row]))
        return torch.stack([row[0] for row in rows]), torch.stack([row[1] for row in rows])

    def _save_pretrained(
        self, save_directory: Path, state_dict: dict[str, Tensor] | None = None
    ) -> None:
        # The memories are buffers, whole on every process, so a gathered state dict adds nothing.
        self.config._save_pretrained(save_directory)
        checkpoint.save_weights(self.model, save_directory)

    @classmethod
    def _load_as_safetensor(
        cls, model: "HASMPolicy", model_file: str, map_location: str, strict: bool
    ) -> "HASMPolicy":
        # Always strict: a memory that is empty or partly loaded would hold the robot still.
        checkpoint.load_weights(model.model, Path(model_file).parent)
        return model
