"""The memory inside a network that is trained end to end, beside the same network without it.

Every sequence is a walk s₁, s₂, ... through a table that is drawn anew for it: under the touch oₜ
the state sₜ is always followed by the same state. Nothing about the table can be kept in weights,
so whoever predicts the next state must note each pair (state, touch) and what followed it, and
find it again when the pair comes back. Predictions count where it came before; guessing is right
in 1 of ``states`` cases.

Both networks embed state and touch, run a GRU and read the next state from a linear layer. One
has a memory that starts empty in every sequence:

    mₜ = sign(E sₜ) ⊗ sign(A oₜ),   d = S₋₁ softmax(β Mᵀ mₜ) over the steps before t,

with the embeddings E, A (straight-through signs), the successors' embedding and β learned. The
other one gets a wider GRU, so that it has more parameters.

    python examples/train_in_network.py
"""

import time
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from hasm_torch import binarise, functional
from hasm_torch.apps.command_line import parse_options


@dataclass
class Options:
    """Options of the command line.

    Attributes:
        steps: Training steps of each network.
        seeds: Networks of each kind, each with its own data.
        states: Number of states.
        touches: Number of touches.
        length: Steps of a sequence.
        batch: Sequences a training step.
        threads: CPU threads.
    """

    steps: int = 300
    seeds: int = 3
    states: int = 12
    touches: int = 2
    length: int = 32
    batch: int = 32
    threads: int = 1


# Entries of a code, of an embedding, and units of the GRU beside the memory and without it.
CODE, EMBEDDING, UNITS, UNITS_ALONE = 32, 16, 32, 64

LEARNING_RATE = 5e-3


class Walks:
    """Random walks, each through its own random table."""

    def __init__(self, options: Options, seed: int) -> None:
        self.options = options
        self.generator = torch.Generator().manual_seed(seed)

    def draw(self) -> tuple[Tensor, Tensor, Tensor]:
        """Draw a batch.

        Returns:
            States (batch, length + 1); touches (batch, length); (batch, length) bool, whether the
            pair of state and touch came before, so that what follows can be known.
        """
        o, generator = self.options, self.generator
        table = torch.rand(o.batch, o.touches, o.states, generator=generator).argsort(-1)
        touch = torch.randint(0, o.touches, (o.batch, o.length), generator=generator)
        states = [torch.randint(0, o.states, (o.batch,), generator=generator)]
        rows = torch.arange(o.batch)
        for step in range(o.length):
            states.append(table[rows, touch[:, step], states[-1]])
        state = torch.stack(states, 1)
        pair = state[:, :-1] * o.touches + touch
        same = pair.unsqueeze(2) == pair.unsqueeze(1)
        return state, touch, same.tril(-1).any(-1)


class Predictor(nn.Module):
    """Predicts the next state, with or without the memory.

    Args:
        options: Sizes of the task.
        with_memory: Whether it has the memory.
    """

    def __init__(self, options: Options, with_memory: bool) -> None:
        super().__init__()
        self.with_memory = with_memory
        units = UNITS if with_memory else UNITS_ALONE
        self.state = nn.Embedding(options.states, EMBEDDING)
        self.touch = nn.Embedding(options.touches, EMBEDDING)
        self.gru = nn.GRU(2 * EMBEDDING, units, batch_first=True)
        if with_memory:
            self.state_code = nn.Linear(EMBEDDING, CODE)
            self.touch_code = nn.Linear(EMBEDDING, CODE)
            self.beta = nn.Parameter(torch.tensor(0.1))
            units += EMBEDDING
        self.head = nn.Linear(units, options.states)

    def forward(self, state: Tensor, touch: Tensor) -> Tensor:
        """Logits of the next state.

        Args:
            state: (batch, length + 1), the last one serving as a successor only.
            touch: (batch, length).

        Returns:
            (batch, length − 1, states) for the states that follow steps 2, 3, ...
        """
        states, touches = self.state(state), self.touch(touch)
        features, _ = self.gru(torch.cat([states[:, :-1], touches], -1))
        features = features[:, 1:]
        if self.with_memory:
            features = torch.cat([features, self.remember(states, touches)], -1)
        return self.head(features)

    def remember(self, states: Tensor, touches: Tensor) -> Tensor:
        """What followed the same pair earlier in the sequence.

        Args:
            states: (batch, length + 1, embedding).
            touches: (batch, length, embedding).

        Returns:
            (batch, length − 1, embedding).
        """
        associations = functional.associate(
            binarise(self.state_code(states[:, :-1])), binarise(self.touch_code(touches))
        )
        length = associations.shape[1]
        earlier = torch.ones(length - 1, length, dtype=torch.bool).tril()
        mask = earlier.expand(len(associations), -1, -1)
        return functional.recall(
            associations[:, 1:], associations, states[:, 1:], self.beta, mask=mask
        )


def train(options: Options, with_memory: bool, seed: int) -> tuple[Predictor, float]:
    """Train a network and test it on new walks.

    Args:
        options: Sizes and steps.
        with_memory: Whether the network has the memory.
        seed: Seed of the weights and of the walks.

    Returns:
        The network and the share of the knowable successors that it predicts in 512 new walks or
        more.
    """
    torch.manual_seed(seed)
    network = Predictor(options, with_memory)
    optimizer = torch.optim.Adam(network.parameters(), lr=LEARNING_RATE)
    walks = Walks(options, seed)
    for _ in range(options.steps):
        state, touch, known = walks.draw()
        logits, wanted, known = network(state, touch), state[:, 2:], known[:, 1:]
        loss = nn.functional.cross_entropy(logits[known], wanted[known])
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
    walks = Walks(options, 1_000_000 + seed)
    right = total = 0
    with torch.no_grad():
        for _ in range(-(-512 // options.batch)):
            state, touch, known = walks.draw()
            hits = network(state, touch).argmax(-1) == state[:, 2:]
            right += int(hits[known[:, 1:]].sum())
            total += int(known[:, 1:].sum())
    return network, right / total


def parameters(network: nn.Module) -> int:
    """Number of parameters of a network."""
    return sum(parameter.numel() for parameter in network.parameters())


def main() -> None:
    """Train both kinds of network with several seeds and print the table."""
    options = parse_options(Options)
    torch.set_num_threads(options.threads)
    print(f"guessing: {1 / options.states:.3f}; {options.steps} training steps each")
    print(f"{'network':16} {'parameters':>10}  share of knowable successors predicted, by seed")
    for name, with_memory in (("with memory", True), ("without memory", False)):
        start = time.perf_counter()
        runs = [train(options, with_memory, seed) for seed in range(options.seeds)]
        shares = "  ".join(f"{share:.3f}" for _, share in runs)
        mean = sum(share for _, share in runs) / len(runs)
        seconds = time.perf_counter() - start
        print(
            f"{name:16} {parameters(runs[0][0]):10,}  {shares}   mean {mean:.3f}  ({seconds:.0f} s)"
        )


if __name__ == "__main__":
    main()
