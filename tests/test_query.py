"""The code of what a robot does and feels: equal to its equations, and telling touches apart."""

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
import reference
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from toys import make_body, postures, settled

from hasm_torch import kernels
from hasm_torch.body import Body
from hasm_torch.config import HASMConfig
from hasm_torch.encoders.bipolar import binarise
from hasm_torch.model.query import QueryCode

BODY = make_body(3)
BOUND = make_body(3, observations={"observation.place": 2})
RANGES = [[-1.0, 1.0], [0.2, 0.9]]
QUARTER, EIGHTH = np.pi / 2, np.pi / 4
# A robot of many rigid bodies, and so of many keys.
MANY = Body(
    ["a", "b", "c"], [-1.0] * 3, [1.0] * 3, [1.0] * 3, [f"p{i}" for i in range(40)], [1] * 40,
    [[1.0, 0.0, 0.0]] * 40, groups=list(range(40)),
)  # fmt: skip


def directions(count: int, seed: int) -> torch.Tensor:
    toward = np.random.default_rng(seed).normal(size=(count, 3))
    return torch.from_numpy(toward / np.linalg.norm(toward, axis=1, keepdims=True))


def touched(code: QueryCode, direction, patch=0, density=0.5, position=0.1) -> torch.Tensor:
    """Queries that differ by the touch alone, (K, D)."""
    direction = torch.as_tensor(direction, dtype=torch.float64).reshape(-1, 3)
    count = len(direction)
    patch = torch.as_tensor(patch).expand(count)
    joints = torch.full((count, 3), position, dtype=torch.float64)
    return code(joints, torch.full((count,), density), patch, direction)


def expected_query(
    code: QueryCode, config, q, density, patch, direction, observation
) -> np.ndarray:
    """q = s ⊗ o ⊗ p of one touch by the reference, with the keys that were drawn."""
    size = config.neurons, config.bits, config.width, config.code
    joints = code.joints
    lower, upper = (np.array(x)[joints] for x in (BODY.lower, BODY.upper))
    levels = reference.place_levels(q[joints], lower, upper, *size)
    ranking = -code.rank.numpy() if config.ranks == "fixed" else levels
    key = code.keys[code.parts[patch]].numpy()
    touch = reference.touch_code(
        density, ranking, config.bits, key, direction, code.angle, code.mixing.numpy()
    )
    query = reference.place_bits(levels, config.bits, config.code) * touch
    if observation is None:
        return query
    seen = reference.place_bits(
        reference.place_levels(observation, *np.transpose(RANGES), *size), config.bits, config.code
    )
    return query * seen[code.shuffle.numpy()]


@given(
    size=st.sampled_from([(10, 16, "thermometer"), (7, 4, "binary"), (5, 5, "gray")]),
    ranks=st.sampled_from(["fixed", "place"]),
    touch=st.sampled_from(["direction", "patch"]),
    angle=st.sampled_from([QUARTER, EIGHTH, 2.0]),
    joints=st.sampled_from([[0, 2], [1], [0, 1, 2]]),
    bound=st.booleans(),
    seed=st.integers(0, 9999),
)
@settings(max_examples=40, deadline=None)
def test_queries_are_those_of_the_equations(size, ranks, touch, angle, joints, bound, seed):
    neurons, bits, kind = size
    config = HASMConfig(neurons=neurons, bits=bits, code=kind, ranks=ranks)
    body = BOUND if bound else BODY
    chosen = settled(body, touch=touch, angle=angle, joints=joints, observed=RANGES * bound)
    code = QueryCode(config, body, chosen)
    rng, count = np.random.default_rng(seed), 5
    q, direction = torch.from_numpy(postures(BODY, count, seed, 1.1)), directions(count, seed)
    direction[2] = 0.0  # nothing pushes
    density = torch.from_numpy(rng.random(count)).float().double()
    patch = torch.from_numpy(rng.integers(0, 3, count))
    observation = torch.from_numpy(rng.uniform(-1, 1, (count, 2))) if bound else None
    if observation is not None:
        observation = observation.float().double()
    compiled = code(q, density, patch, direction, observation)
    with kernels.disabled():
        plain = code(q, density, patch, direction, observation)
    assert compiled.dtype == plain.dtype == torch.float32
    torch.testing.assert_close(compiled, plain, rtol=0, atol=1e-4)
    one = code.in_arrays(
        q[1].numpy(), float(density[1]), int(patch[1]), direction[1].numpy(),
        np.zeros(0) if observation is None else observation[1].numpy(),
    )  # fmt: skip
    assert torch.equal(one, compiled[1])
    for row in range(count):
        seen = None if observation is None else observation[row].numpy()
        felt = float(density[row]), int(patch[row]), direction[row].numpy(), seen
        expected = expected_query(code, config, q[row].numpy(), *felt)
        assert expected.shape == (code.code_dim,)
        np.testing.assert_allclose(compiled[row], expected, atol=1e-4)
        clear = np.abs(expected) > 1e-3  # elsewhere rounding decides the sign
        signs = binarise(compiled[row]).numpy()
        np.testing.assert_array_equal(signs[clear], np.sign(expected)[clear])


def match(code: QueryCode, one: torch.Tensor, other: torch.Tensor) -> np.ndarray:
    return ((one * other).sum(-1) / code.code_dim).numpy()


@pytest.mark.parametrize("angle", [QUARTER, EIGHTH])
def test_the_match_of_two_touches_depends_on_the_angle_between_them_alone(angle):
    """Averaged over keys, tr(R(n)ᵀ R(n′)) / 3 of each block: at 90° (c² + 2c) / 3."""
    code = QueryCode(HASMConfig(), MANY, settled(MANY, angle=angle))
    cosine = np.linspace(-1, 1, 9)
    first, aside = directions(30, 1), directions(30, 2)
    aside = torch.linalg.cross(first, aside)
    aside /= aside.norm(dim=1, keepdim=True)
    turn = code.angle * 10.0 ** (-np.arange(1, code.code_dim // 3 + 1) / code.code_dim)
    c, s = np.cos(turn), np.sin(turn)
    found = np.zeros((9, 30))
    for i, near in enumerate(cosine):
        second = near * first + np.sqrt(1 - near**2) * aside
        for patch in range(40):
            pair = touched(code, first, patch), touched(code, second, patch)
            found[i] += match(code, *pair) / 40
    trace = 3 * c**2 + 2 * c * (1 - c) + 2 * s**2 * cosine[:, None] + (1 - c) ** 2 * cosine[
        :, None
    ] ** 2  # fmt: skip
    np.testing.assert_allclose(found.mean(1), trace.mean(1) / 3, atol=0.01)
    assert found.std(1).max() < 0.03  # whatever the two directions are
    if angle == QUARTER:  # the slowest blocks turn by 42° only
        shape = (cosine**2 + 2 * cosine) / 3
        assert np.corrcoef(found.mean(1), shape)[0, 1] > 0.97


@given(seed=st.integers(0, 9999))
@settings(max_examples=25, deadline=None)
def test_no_direction_is_a_jump(seed):
    code = QueryCode(HASMConfig(), BODY, settled(BODY))
    rng = np.random.default_rng(seed)
    toward = directions(1, seed).numpy()[0] if seed % 2 else np.array([0.0, 0.0, -1.0])
    near = toward + 1e-3 * rng.normal(size=3)
    near /= np.linalg.norm(near)
    one, other = touched(code, np.stack([toward, near]))
    moved = float((one - other).norm() / code.code_dim**0.5)
    assert moved <= 3 * np.linalg.norm(toward - near)


def correlation(codes: np.ndarray, toward: np.ndarray) -> float:
    """Of the match of codes with the cosine of the angle between their touches."""
    pairs = np.triu_indices(len(toward), 1)
    return float(np.corrcoef((codes @ codes.T)[pairs], (toward @ toward.T)[pairs])[0, 1])


def test_signs_tell_directions_thanks_to_the_mixing():
    """Turned by 45° or less, most entries keep their sign; those of mixed blocks do not."""
    toward = directions(30, 3).numpy()
    code = QueryCode(HASMConfig(bits=6), BODY, settled(BODY, angle=EIGHTH))
    ranking, key = -code.rank.numpy(), code.keys[code.parts[0]].numpy()
    plain = np.tile(np.eye(3), (code.code_dim // 3, 1, 1))
    bare = [reference.touch_code(0.5, ranking, 6, key, n, EIGHTH, plain) for n in toward]
    bare = np.stack(bare)
    assert correlation(bare, toward) > 0.95  # the real-valued code tells them
    assert correlation(np.sign(bare), toward) < 0.6
    assert correlation(touched(code, toward).sign().numpy(), toward) > 0.9


def test_the_mixing_changes_no_inner_product():
    code = QueryCode(HASMConfig(), BODY, settled(BODY))
    torch.testing.assert_close(
        code.mixing @ code.mixing.mT, torch.eye(3).double().expand(len(code.mixing), 3, 3)
    )
    codes = touched(code, directions(20, 4))
    torch.testing.assert_close(codes.norm(dim=1), torch.full((20,), code.code_dim**0.5))


def test_rigid_bodies_have_keys_of_their_own():
    code = QueryCode(HASMConfig(), BODY, settled(BODY))
    toward = directions(20, 5)
    front, side, back = (touched(code, toward, patch) for patch in range(3))
    assert torch.equal(front, side)  # of one rigid body: the direction alone tells
    assert np.abs(match(code, front, back)).max() < 0.25


def test_where_the_patch_tells_touches_apart_the_direction_does_not():
    code = QueryCode(HASMConfig(), BODY, settled(BODY, touch="patch"))
    toward = directions(10, 6)
    codes = [touched(code, toward, patch) for patch in range(3)]
    for mine in codes:
        assert torch.equal(mine, mine[:1].expand_as(mine))
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert np.abs(match(code, codes[a], codes[b])).max() < 0.25


def test_without_rope3d_touches_of_one_body_are_one():
    code = QueryCode(HASMConfig(rope=False), BODY, settled(BODY))
    codes = touched(code, directions(10, 7), torch.arange(10) % 2)
    assert torch.equal(codes, codes[:1].expand_as(codes))
    turned = QueryCode(HASMConfig(), BODY, settled(BODY))
    apart = touched(turned, [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    assert match(turned, *apart) < 0.1


def test_the_touch_is_written_into_many_entries():
    """N = round(ρ M) is far above one, and grows with the force."""
    code = QueryCode(HASMConfig(rope=False), BODY, settled(BODY))
    soft, firm, hard = (touched(code, np.zeros(3), 0, d)[0] for d in (0.16, 0.5, 0.9))
    key_and_state = -touched(code, np.zeros(3), 0, 0.0)[0]  # N = 0: every entry is −1
    active = [int((q * key_and_state > 0).sum()) for q in (soft, firm, hard)]
    assert active == [16 * round(d * 30) for d in (0.16, 0.5, 0.9)]
    assert active[0] >= 80


@pytest.mark.parametrize("ranks", ["fixed", "place"])
def test_of_a_fixed_order_the_touch_tells_the_force_alone(ranks):
    """Of two postures s differs; o does only where the place code ranks the neurons."""
    config = HASMConfig(ranks=ranks, rope=False)
    code = QueryCode(config, BODY, settled(BODY))
    touch = []
    for position in (-0.6, 0.5):
        nothing = -touched(code, np.zeros(3), 0, 0.0, position)[0]
        touch.append(touched(code, np.zeros(3), 0, 0.4, position)[0] * nothing)
    assert torch.equal(*touch) == (ranks == "fixed")


def test_what_is_observed_besides_is_bound():
    code = QueryCode(HASMConfig(), BOUND, settled(BOUND, observed=RANGES))
    places = torch.tensor([[-0.8, 0.3], [-0.7, 0.3], [0.5, 0.3], [-0.8, 0.85]])
    row = torch.zeros(4, 3), torch.full((4,), 0.5), torch.zeros(4, dtype=torch.int64)
    codes = code(*row, directions(1, 0).expand(4, 3), places)
    same, near, far, other = ((codes * codes[0]).sum(-1) / code.code_dim).tolist()
    assert same == pytest.approx(1.0, abs=1e-5)
    assert 0.6 < near < 1.0
    assert far < near
    assert other < near
    # p is shuffled, so that it does not change sign together with s
    plain = QueryCode(HASMConfig(), BODY, settled(BODY))(*row, directions(1, 0).expand(4, 3))
    bits = codes[0] / plain[0]
    assert set(bits.round().tolist()) == {-1.0, 1.0}
    joint_0 = bits.reshape(3, -1)[0]  # the entries of a joint hold some of both observations
    assert 0.1 < (joint_0 > 0).float().mean() < 0.9


def test_what_cannot_be_coded_is_named():
    chosen = settled(BOUND, observed=RANGES)
    code = QueryCode(HASMConfig(), BOUND, chosen)
    row = torch.zeros(1, 3), torch.tensor([0.5]), torch.tensor([0]), torch.zeros(1, 3)
    with pytest.raises(ValueError, match=r"binds 2 further observations: give step"):
        code(*row)
    bad = torch.tensor([[0.0, torch.nan, 0.0]])
    for wrapped in (kernels.disabled, nullcontext):
        with wrapped(), pytest.raises(ValueError, match=r"others at joints \[1\]"):
            code(bad, *row[1:], torch.zeros(1, 2))


def test_keys_belong_to_the_method():
    """Two models code alike, whatever was drawn before; the global generator is left alone."""
    before = torch.random.get_rng_state()
    one = QueryCode(HASMConfig(), BODY, settled(BODY))
    assert torch.equal(torch.random.get_rng_state(), before)
    torch.rand(5)
    other = QueryCode(replace(HASMConfig(), beta=3.0), BODY, settled(BODY))
    toward = directions(4, 8)
    assert torch.equal(touched(one, toward), touched(other, toward))
    assert not one.state_dict().keys() - {"place_code.lower", "place_code.upper"}
