"""Choosing what fits some episodes, by predicting the ones that are held out.

Each sample is predicted from all episodes but its own, joints in shares of their speed limits. The
error of a course is the squared one, that of a displacement 1 minus the cosine to the real one (and
a little of the squared one); both are divided by that of standing still: 1 is no better than that.

    1. what tells touches apart, and which of the moved joints are coded: they are left out one by
       one as long as the error does not rise, at some usual β, for each kind of touch;
    2. β and the read-out, on a grid;
    3. what is recalled: the displacement of a spike, or the course of a touch, each driven from
       the first moment of a held-out touch to its end. A course that follows one demonstration
       alone is the walk over its states.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hasm_torch.body import Body
from hasm_torch.config import HASMConfig
from hasm_torch.encoders.bipolar import binarise
from hasm_torch.model.frames import base_indices, into_base, out_of_base
from hasm_torch.model.lessons import COURSE_POINTS
from hasm_torch.model.query import QueryCode, parts_of
from hasm_torch.model.readout import covariates_of, first_order, ridge_of, stored_values
from hasm_torch.model.settled import Settled
from hasm_torch.model.table import Table

Array = NDArray[np.float64]

# βD that are tried: from the mean of everything to the argmax. exp(−βD (1 − c)) is the weight of
# an association whose code agrees by c.
SOFTNESSES = (0.0, 4.0, 8.0, 15.0, 30.0, 60.0, float("inf"))
SHARP_SOFTNESS = 60.0  # where each demonstration is the only one of its kind
USUAL = (8.0, 15.0, float("inf"))  # at which joints and touch are compared
# Displacements are judged by their direction; their size, which a mean over directions makes
# smaller and thereby safer, counts this much beside it.
SIZE_SHARE = 0.1
ARGMAX_BETA = 1e4  # of inner products, which differ by 2 at least where entries are ±1
ANGLES = {"mean": np.pi / 2, "first_order": np.pi / 4}
# Rows predicted at most, and rows from which they are predicted, evenly spread over the episodes;
# taking more than 1,500 rows changes no choice for the bundled episodes.
QUERIES, PHASES, ROWS = 160, 48, 1500
LOSS = 1.01  # a joint is left out unless the error rises by this factor
EVEN = 1.02  # the mean, which shrinks what it averages over, must be better by this factor
# The patch, which says nothing of one that was not touched, must be better than the direction by
# this factor: where it names the function it is by far, and ten episodes misjudge by a fifth.
NAMED = 1.3
# Of a few episodes on different patches, what predicts no better than this share of standing still
# tells nothing.
TELLING = 0.9
# In the middle between the courses of pushes that the robot yields to, straight by 0.95 with a
# wandering finger, and those of grasps, 0.79.
STRAIGHT = 0.87


@dataclass
class Choice:
    """One setting that was chosen.

    Attributes:
        settled: With the setting.
        errors: Error of every value tried, by its name.
    """

    settled: Settled
    errors: dict[str, dict[str, float]]


class HeldOut:
    """Predictions of rows of a table by all rows of other episodes.

    Args:
        config: Settings of the method.
        body: Joints and skin of the robot.
        table: What is stored, and of which some rows are predicted.
        values: (K, V) what is recalled of each row.
        weight: (V,) by which an error in each entry counts.
        most: Rows predicted at most.
        still: (K, V) what standing still would predict; zero by default.
        named: Whether only other touches of the same patch tell anything, two at least; by default
            one of the same rigid body is enough.
    """

    def __init__(
        self,
        config: HASMConfig,
        body: Body,
        table: Table,
        values: Tensor,
        weight: Tensor,
        most: int,
        still: Tensor | None = None,
        named: bool = False,
    ) -> None:
        self.config, self.body, self.table = config, body, table
        self.values, self.weight = values, weight
        self._rows: Tensor | None = None
        self._absent: dict[str, Tensor] = {}
        every = np.unique(np.linspace(0, len(table) - 1, most).round().astype(int))
        groups = table.episode if len(set(table.episode)) > 1 else np.arange(len(table))
        other = groups[every, None] != groups[None]
        part = np.array(parts_of(body, "patch" if named else "direction"))[table.patch]
        alike = (other & (part[every, None] == part[None])).sum(axis=1)
        known = alike > (1 if named else 0)
        self.asked, self.possible = every[known], bool(known.any())
        self._own = ~torch.from_numpy(other[known])
        self._unmoved = (torch.zeros_like(values) if still is None else still)[self.asked]
        self.still = self._cost(self._unmoved)
        self.directed = still is None

    def _cost(self, predicted: Tensor) -> float:
        wrong = (predicted - self.values[self.asked]) * self.weight
        return float(wrong.square().sum()) or 1e-12

    def _misled(self, predicted: Tensor) -> float:
        """1 − cosine between predicted and real displacements, each counted by its length."""
        real, guess = self.values[self.asked] * self.weight, predicted * self.weight
        length = real.norm(dim=-1)
        along = (real * guess).sum(-1) / guess.norm(dim=-1).clamp(min=1e-12)
        return float((length - along).sum() / length.sum().clamp(min=1e-12))

    def scores(self, settled: Settled) -> Tensor:
        """Agreement of the asked rows' codes with all rows' codes, (asked, K), at most about 1."""
        codes = table_codes(self.config, self.body, settled, self.table)
        return codes[self.asked] @ codes.T / codes.shape[1]

    def error(self, settled: Settled, scores: Tensor, softness: float) -> float:
        """Error of the predictions of a read-out, relative to standing still."""
        predicted = self.predicted(settled, scores, softness)
        size = self._cost(predicted) / self.still
        if not self.directed:
            return size
        return (self._misled(predicted) + SIZE_SHARE * size) / (1.0 + SIZE_SHARE)

    def _absence(self, settled: Settled) -> Tensor:
        """(asked, K) −∞ at rows of the same episode or of another part, else 0."""
        if settled.touch not in self._absent:
            patch = self.table.patch
            apart = other_parts(self.body, settled, patch[self.asked], patch)
            self._absent[settled.touch] = absence(self._own | apart)
        return self._absent[settled.touch]

    def best_error(self, settled: Settled, scores: Tensor) -> float:
        """The lowest of the errors of some usual recalls."""
        return min(self.error(settled, scores, s) for s in USUAL)

    def predicted(self, settled: Settled, scores: Tensor, softness: float) -> Tensor:
        """(asked, V) predictions."""
        absent = self._absence(settled)
        # Of a patch that no other episode touches, the patch says nothing: it stands still.
        nothing = (absent < 0).all(-1, keepdim=True)
        weights = soft_weights(scores, absent.masked_fill(nothing, 0.0), softness)
        if settled.readout == "mean":
            return torch.where(nothing, self._unmoved, weights @ self.values)
        x, ridge = covariates(settled, self.table)
        if self._rows is None:  # the same for every choice of joints, touch and β
            values = stored_values(self.values.double().numpy(), x)
            self._rows = torch.from_numpy(values).float()
        recalled = (weights @ self._rows).double().numpy()
        law = torch.from_numpy(first_order(recalled, x[self.asked], ridge)).float()
        return torch.where(nothing, self._unmoved, law)


def other_parts(
    body: Body, settled: Settled, asked: NDArray[np.int64], stored: NDArray[np.int64]
) -> Tensor:
    """Which stored touches are of another part than the asked ones, (asked, stored)."""
    part = np.array(parts_of(body, settled.touch))
    return torch.from_numpy(part[asked][:, None] != part[stored][None])


def covariates(settled: Settled, table: Table, at: int = 0) -> tuple[Array, Array]:
    """Covariates (K, X) of the rows of a table, at a point of their course, and their ridge."""
    observed = np.array(settled.observed).reshape(-1, 2)
    direction = table.direction if table.direction.ndim == 2 else table.direction[:, at]
    x = covariates_of(settled.value, direction, table.observation, observed)
    return x, ridge_of(settled.value, len(observed))


def absence(excluded: Tensor) -> Tensor:
    """−∞ where something is excluded, else 0: what is added to scores."""
    return torch.zeros(excluded.shape).masked_fill_(excluded, -torch.inf)


def soft_weights(scores: Tensor, absent: Tensor, softness: float) -> Tensor:
    """Recall weights of agreements (..., K) at some βD; infinity is the argmax.

    Args:
        scores: (..., K) agreements.
        absent: (..., K) see ``absence``.
        softness: βD.
    """
    if np.isinf(softness):
        present = scores + absent
        best = present >= present.amax(-1, keepdim=True) - 1e-6
        return best / best.sum(-1, keepdim=True)
    return torch.softmax((softness * scores).add_(absent), -1)


def table_codes(config: HASMConfig, body: Body, settled: Settled, table: Table) -> Tensor:
    """Codes of all rows of a table, as the memory holds them, (K, D)."""
    return _codes(config, settled, QueryCode(config, body, settled), table)


def _codes(
    config: HASMConfig, settled: Settled, code: QueryCode, table: Table, at: int = 0
) -> Tensor:
    """The same by a code that is there, at a point of the rows' courses."""
    direction = table.direction if table.direction.ndim == 2 else table.direction[:, at]
    density = np.clip(table.density, settled.density[0], settled.density[1])
    columns = (table.positions, density, table.patch, direction)
    observation = torch.from_numpy(table.observation) if settled.observed else None
    codes = code(*map(torch.from_numpy, columns), observation)
    return binarise(codes) if config.storage == "bit" else codes


def choose(
    config: HASMConfig, body: Body, settled: Settled, samples: Table, phases: Table
) -> Choice:
    """Settle what the settings leave open; see the module.

    Args:
        config: Settings of the method; what they name is kept.
        body: Joints and skin of the robot.
        settled: What is settled already.
        samples: Stretches of motion that the episodes hold.
        phases: Touches that they hold.

    Returns:
        The choice, and the errors of what was tried.
    """
    errors: dict[str, dict[str, float]] = {}
    options = {}
    samples, phases = _thin(samples), _thin(phases)
    for value in ("displacement", "goal"):
        wanted = config.value if config.value != "successor" else "goal"
        if wanted in ("auto", value):
            table = samples if value == "displacement" else phases
            option = replace(settled, value=value)
            options[value] = _choose_recall(config, body, option, table, errors)
    if len(options) == 2:
        held = phase_errors(config, body, options, samples, phases)
        # Where the episodes cannot tell, one whose touches lead straight on is taken to yield.
        tell = bool(held) and min(held.values()) < TELLING
        usual = "displacement" if straightness(body, phases) > STRAIGHT else "goal"
        best = min(held, key=held.__getitem__) if tell else usual
        errors |= {"value": held} if tell else {}
        if not tell and best == "displacement":
            options[best] = _unjudged(config, body, replace(settled, value=best), samples)
    else:
        best = next(iter(options))
    chosen = options[best]
    if config.value == "successor" or (best == "goal" and chosen.beta >= ARGMAX_BETA):
        # A walk that averages next states stalls: one of them must win.
        beta = ARGMAX_BETA if config.beta is None else chosen.beta
        chosen = replace(chosen, value="successor", readout="mean", beta=beta)
    return Choice(chosen, errors)


def _thin(table: Table) -> Table:
    if len(table) <= ROWS:
        return table
    return table.rows(np.linspace(0, len(table) - 1, ROWS).round().astype(int))


def _choose_recall(
    config: HASMConfig,
    body: Body,
    settled: Settled,
    table: Table,
    errors: dict[str, dict[str, float]],
) -> Settled:
    """Touch, joints, read-out and β for one kind of value."""
    values, weight = recalled_values(body, settled, table)
    most = QUERIES if settled.value == "displacement" else PHASES
    still, course = unmoved(body, settled, table), settled.value != "displacement"
    held = HeldOut(config, body, table, values, weight, most, still, named=course)
    readouts = _readouts(config, settled)
    usual = replace(settled, readout=readouts[-1], angle=angle_of(config, readouts[-1]))
    touches = _touches(config)
    if not held.possible:
        return _unjudged(config, body, settled, table)
    tried: dict[str, tuple[float, Settled]] = {}
    for touch in touches:
        tried[touch] = _coded_joints(config, body, replace(usual, touch=touch), held)
    errors[f"{settled.value}: touch"] = {name: error for name, (error, _) in tried.items()}
    usual = min(tried.items(), key=lambda t: t[1][0] * (NAMED if t[0] == "patch" else 1.0))[1][1]
    grid: dict[str, tuple[float, Settled]] = {}
    for readout in readouts:
        option = replace(usual, readout=readout, angle=angle_of(config, readout))
        scores = held.scores(option)
        dim = len(option.joints) * config.neurons * config.bits
        softnesses = SOFTNESSES if config.beta is None else (config.beta * dim,)
        for softness in softnesses:
            beta = min(softness / dim, ARGMAX_BETA)
            grid[f"{readout}, βD = {softness:g}"] = (
                held.error(option, scores, softness),
                replace(option, beta=beta),
            )
    errors[f"{settled.value}: read-out"] = {name: error for name, (error, _) in grid.items()}

    def judged(pair: tuple[float, Settled]) -> float:
        return pair[0] * (EVEN if pair[1].readout == "mean" else 1.0)

    return min(grid.values(), key=judged)[1]


def _unjudged(config: HASMConfig, body: Body, settled: Settled, table: Table) -> Settled:
    """What is taken where nothing can be predicted: each demonstration for itself."""
    readout, touches = _readouts(config, settled)[-1], _touches(config)
    joints = _named(config, body) or _differing(body, settled, table)
    return replace(
        settled,
        touch=touches[0] if settled.value == "displacement" else touches[-1],
        readout=readout,
        angle=angle_of(config, readout),
        joints=joints,
        beta=_beta(config, joints, SHARP_SOFTNESS),
    )


def _coded_joints(
    config: HASMConfig, body: Body, settled: Settled, held: HeldOut
) -> tuple[float, Settled]:
    """Leave joint after joint out while the error does not rise."""
    named = _named(config, body)
    if named:
        settled = replace(settled, joints=named)
        return held.best_error(settled, held.scores(settled)), settled
    spread = held.table.positions.std(axis=0)
    span = np.array(body.upper) - np.array(body.lower)
    moved = [j for j in settled.moved if j in body.limited and spread[j] > 1e-6 * span[j]]
    left = moved or body.limited[:1]
    # The score of several joints is the mean of those of each: the codes lie side by side.
    single = {j: held.scores(replace(settled, joints=[j])) for j in left}

    def error_of(joints: list[int]) -> float:
        return held.best_error(settled, torch.stack([single[j] for j in joints]).mean(0))

    lowest = error_of(left)
    while len(left) > 1:
        trials = {j: error_of([i for i in left if i != j]) for j in left}
        spare = min(trials, key=trials.__getitem__)
        if trials[spare] > LOSS * lowest:
            break
        left, lowest = [j for j in left if j != spare], trials[spare]
    return lowest, replace(settled, joints=left)


def _differing(body: Body, settled: Settled, table: Table) -> list[int]:
    """The joints with limits that a touch moves or finds elsewhere, or the first one."""
    found = np.ptp(table.positions, axis=0) > 0.02 * (np.array(body.upper) - np.array(body.lower))
    return [j for j in body.limited if found[j] or j in settled.moved] or body.limited[:1]


def _named(config: HASMConfig, body: Body) -> list[int]:
    """Indices of the joints that the settings name."""
    limited = [body.joints[j] for j in body.limited]
    wrong = [name for name in config.joints or [] if name not in limited]
    if wrong:
        raise ValueError(
            f"cannot code the joints {', '.join(wrong)}; joints with limits: {', '.join(limited)}"
        )
    return sorted(body.joints.index(name) for name in config.joints or [])


def _touches(config: HASMConfig) -> list[str]:
    return ["direction", "patch"] if config.touch == "auto" else [config.touch]


def _readouts(config: HASMConfig, settled: Settled) -> list[str]:
    """What can be chosen from: without anything to vary, a course has its mean alone."""
    if settled.value != "displacement" and not settled.observed:
        return ["mean"]
    return ["mean", "first_order"] if config.readout == "auto" else [config.readout]


def angle_of(config: HASMConfig, readout: str) -> float:
    """Angle θ of RoPE3D, rad."""
    return ANGLES[readout] if config.rope_angle is None else config.rope_angle


def _beta(config: HASMConfig, joints: list[int], softness: float) -> float:
    if config.beta is not None:
        return min(config.beta, ARGMAX_BETA)
    return softness / (len(joints) * config.neurons * config.bits)


def straightness(body: Body, phases: Table) -> float:
    """Median over touches of the distance from first to last point over the way between them."""
    course = phases.moved / np.array(body.max_speed)
    way = np.linalg.norm(np.diff(course, axis=1), axis=2).sum(axis=1)
    far = np.linalg.norm(course[:, -1] - course[:, 0], axis=1)
    return float(np.median(far[way > 0] / way[way > 0])) if (way > 0).any() else 0.0


def unmoved(body: Body, settled: Settled, table: Table) -> Tensor:
    """(K, V) values of ``recalled_values`` if no joint moved."""
    standing = Table(**{**vars(table), "moved": np.zeros_like(table.moved)})
    return recalled_values(body, settled, standing)[0]


def recalled_values(body: Body, settled: Settled, table: Table) -> tuple[Tensor, Tensor]:
    """What is recalled of each row (K, V), and by which its errors count (V,).

    A displacement is that of one spike. A course gives the positions of joints with limits, and
    the displacement since the touch began of those without; then the spikes that it takes.
    """
    moved = settled.moved
    speed = torch.tensor(body.max_speed, dtype=torch.float32)[moved]
    if settled.value == "displacement":
        values = table.moved[:, moved] / table.spikes[:, None]
        return torch.from_numpy(values).float(), 1.0 / speed
    anchored = np.array([j in body.limited for j in moved])
    course = table.moved[:, :, moved] + np.where(anchored, table.positions[:, moved], 0.0)[:, None]
    values = np.concatenate([course.reshape(len(table), -1), table.spikes[:, None]], axis=1)
    weight = torch.cat([(1.0 / speed).repeat(COURSE_POINTS), torch.zeros(1)])
    return torch.from_numpy(values).float(), weight


def phase_errors(
    config: HASMConfig, body: Body, options: dict[str, Settled], samples: Table, phases: Table
) -> dict[str, float]:
    """Error of held-out touches, each driven from its first moment to its end by its own spikes."""
    values, weight = recalled_values(body, options["goal"], phases)
    held = HeldOut(config, body, phases, values, weight, PHASES)
    if len(set(phases.episode)) < 2 or not held.possible:
        return {}  # of one episode, no touch can be driven by others
    asked = held.asked
    moved = options["goal"].moved
    speed = np.array(body.max_speed)[moved]
    real = phases.moved[asked][:, :, moved]
    still = float(np.square(real / speed).sum()) or 1e-12
    dim = len(options["goal"].joints) * config.neurons * config.bits
    scores = held.scores(options["goal"])
    course = held.predicted(options["goal"], scores, softness_of(options["goal"].beta, dim))
    course = course[:, :-1].unflatten(1, (COURSE_POINTS, -1)).double().numpy()
    anchored = np.array([j in body.limited for j in moved])
    course = course - np.where(anchored, phases.positions[asked][:, moved], 0.0)[:, None]
    settled = options["displacement"]
    held = HeldOut(config, body, samples, *recalled_values(body, settled, samples), 1)
    driven = _driven(held, settled, phases.rows(asked))[:, :, moved]
    return {
        "displacement": float(np.square((driven - real) / speed).sum()) / still,
        "goal": float(np.square((course - real) / speed).sum()) / still,
    }


def softness_of(beta: float, dim: int) -> float:
    """βD of a settled β."""
    return float("inf") if beta >= ARGMAX_BETA else beta * dim


def _driven(held: HeldOut, settled: Settled, phases: Table) -> Array:
    """(n, N, J) displacements, in the base's frame, as every spike of a phase moves the joints."""
    body, base = held.body, base_indices(held.body)
    at = phases.positions.copy()
    steps = [np.zeros_like(at)]
    own = torch.from_numpy(phases.episode[:, None] == held.table.episode[None])
    apart = own | other_parts(body, settled, phases.patch, held.table.patch)
    nothing = apart.all(-1).numpy()  # such a touch moves nothing
    absent = absence(apart & ~apart.all(-1, keepdim=True))
    code = QueryCode(held.config, body, settled)
    codes = _codes(held.config, settled, code, held.table)
    dim = codes.shape[1]
    rows = held.values
    if settled.readout == "first_order":
        x, ridge = covariates(settled, held.table)
        rows = torch.from_numpy(stored_values(held.values.double().numpy(), x)).float()
    for n in range(COURSE_POINTS - 1):
        now = replace_positions(phases, at)
        query = _codes(held.config, settled, code, now, n)
        weights = soft_weights(query @ codes.T / dim, absent, softness_of(settled.beta, dim))
        recalled = (weights @ rows).double().numpy()
        if settled.readout == "first_order":
            recalled = first_order(recalled, covariates(settled, now, n)[0], ridge)
        step = np.zeros_like(at)
        step[:, settled.moved] = recalled
        step *= np.where(nothing, 0.0, phases.spikes / (COURSE_POINTS - 1))[:, None]
        yaw = at[:, base[2]] if base else 0.0
        at = np.clip(at + out_of_base(step, yaw, base), body.lower, body.upper)
        onset = phases.positions[:, base[2]] if base else 0.0
        steps.append(into_base(at - phases.positions, onset, base))
    return np.stack(steps, axis=1)


def replace_positions(phases: Table, positions: Array) -> Table:
    """The same touches from other positions."""
    return Table(**{**vars(phases), "positions": positions})
