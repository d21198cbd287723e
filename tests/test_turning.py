"""How links turn, and from where a touch pushes."""

import numpy as np
import pytest
import reference
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from toys import cells_of, make_body, postures

from hasm_torch import kernels
from hasm_torch.encoders.skin import SkinEncoder
from hasm_torch.encoders.turning import link_rotation
from hasm_torch.model.felt import PushDirection

BODY = make_body(4)


def random_rows(count: int, joints: int, rng: np.random.Generator) -> np.ndarray:
    """Rows of a chain, some without a joint, some sharing one."""
    rows = np.zeros((count, 15))
    for row in rows:
        row[:9] = Rotation.random(random_state=rng).as_matrix().flatten()
        axis = rng.normal(size=3)
        row[9:12] = axis / np.linalg.norm(axis)
        row[12:] = rng.integers(-1, joints), rng.normal(), rng.normal()
    return rows


@given(count=st.integers(0, 6), moments=st.integers(0, 4), seed=st.integers(0, 9999))
@settings(max_examples=40, deadline=None)
def test_a_link_turns_as_the_product_of_its_chain(count, moments, seed):
    rng = np.random.default_rng(seed)
    rows, q = random_rows(count, 3, rng), rng.normal(size=(moments, 3))
    compiled = link_rotation(rows, q)
    with kernels.disabled():
        plain = link_rotation(rows, q)
    assert compiled.shape == plain.shape == (moments, 3, 3)
    expected = [reference.link_rotation(rows, now) for now in q]
    np.testing.assert_allclose(compiled, np.reshape(expected, compiled.shape), atol=1e-12)
    np.testing.assert_allclose(plain, compiled, atol=1e-12)


@given(seed=st.integers(0, 9999))
@settings(max_examples=20, deadline=None)
def test_rotations_stay_rotations(seed):
    rng = np.random.default_rng(seed)
    turned = link_rotation(random_rows(7, 2, rng), rng.normal(size=(3, 2)))
    np.testing.assert_allclose(turned @ turned.swapaxes(-1, -2), np.tile(np.eye(3), (3, 1, 1)),
                               atol=1e-12)  # fmt: skip
    np.testing.assert_allclose(np.linalg.det(turned), 1.0)


def test_the_references_rotation_is_that_of_scipy():
    rng = np.random.default_rng(0)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    turned = Rotation.from_rotvec(1.2 * axis).as_matrix()
    np.testing.assert_allclose(reference.rodrigues(axis, 1.2), turned, atol=1e-12)


def test_positions_may_be_strided_or_of_another_dtype():
    rows = np.array(BODY.chains["hand"])
    q = postures(BODY, 6, 0)
    expected = link_rotation(rows, q)
    np.testing.assert_array_equal(link_rotation(rows, np.asfortranarray(q)), expected)
    np.testing.assert_array_equal(link_rotation(rows, np.repeat(q, 2, axis=0)[::2]), expected)
    np.testing.assert_allclose(link_rotation(rows, q.astype(np.float32)), expected, atol=1e-6)


pushes = st.lists(st.integers(-5000, 5000).map(lambda x: x / 1000), min_size=9, max_size=9)


@given(values=pushes, seed=st.integers(0, 99), compiled=st.booleans())
@settings(max_examples=40, deadline=None)
def test_a_push_is_seen_from_the_base(values, seed, compiled):
    push = np.array(values, np.float32).reshape(1, 3, 3)
    q = postures(BODY, 1, seed)
    if compiled:
        toward = PushDirection(BODY, "base")(push, q)[0]
    else:
        with kernels.disabled():
            toward = PushDirection(BODY, "base")(push, q)[0]
    for patch, link in enumerate(BODY.links):
        length = np.linalg.norm(push[0, patch].astype(np.float64))
        turned = reference.link_rotation(BODY.chains.get(link, []), q[0]) @ push[0, patch]
        expected = turned / length if length else np.zeros(3)
        np.testing.assert_allclose(toward[patch], expected, atol=1e-9)


def test_a_zero_push_has_no_direction():
    push = np.zeros((2, 3, 3), np.float32)
    push[1, 0, 0] = 1e-30  # far too weak to square in float32
    toward = PushDirection(BODY, "base")(push, postures(BODY, 2, 0))
    assert not toward[0].any()
    assert not toward[1, 1:].any()
    assert np.linalg.norm(toward[1, 0]) == pytest.approx(1.0)


def test_absurd_pushes_have_finite_directions():
    push = np.zeros((1, 3, 3), np.float32)
    push[0] = [[3e38, -3e38, 0.0], [np.inf, 0.0, 0.0], [-np.inf, 1.0, 0.0]]
    q = postures(BODY, 1, 0)
    seen = PushDirection(BODY, "base")
    toward = seen(push, q)[0]
    np.testing.assert_allclose(np.linalg.norm(toward, axis=1), [1.0, 0.0, 1.0])
    for patch in range(3):
        np.testing.assert_allclose(seen.of_patch(patch, push[0, patch], q[0]), toward[patch])


def test_in_the_links_frame_a_direction_does_not_turn():
    push = np.random.default_rng(0).normal(size=(4, 3, 3)).astype(np.float32)
    toward = PushDirection(BODY, "link")(push, postures(BODY, 4, 1))
    expected = push / np.linalg.norm(push, axis=-1, keepdims=True)
    np.testing.assert_allclose(toward, expected, atol=1e-6)


@given(forces=st.lists(st.floats(0, 9, width=32), min_size=3, max_size=3), seed=st.integers(0, 99))
@settings(max_examples=25, deadline=None)
def test_a_bent_patch_pushes_where_its_cells_are_pressed(forces, seed):
    """Directions of one patch differ, by the normals of its cells weighted by their forces."""
    skin = torch.zeros(1, sum(BODY.cells), 3)
    mine = cells_of(BODY, "side")
    skin[0, mine, 0] = torch.tensor(forces)
    encoder = SkinEncoder(BODY.cells, BODY.normals, BODY.rate, 0.0, 1, 2.5, 0.1)
    felt, _ = encoder(skin)
    weighted = -np.array(forces) @ np.array(BODY.normals)[mine]
    np.testing.assert_allclose(felt.push[0, 1], weighted, atol=1e-5)
    q = postures(BODY, 1, seed)
    toward = PushDirection(BODY, "base")(felt.push.numpy(), q)[0, 1]
    if np.linalg.norm(weighted) > 1e-3:
        expected = reference.link_rotation(BODY.chains["hand"], q[0]) @ weighted
        np.testing.assert_allclose(toward, expected / np.linalg.norm(weighted), atol=1e-4)


def test_the_two_sides_of_a_bent_patch_are_two_directions():
    encoder = SkinEncoder(BODY.cells, BODY.normals, BODY.rate, 0.0, 1, 2.5, 0.1)
    toward = []
    for cell in (2, 3):  # on both sides of the patch's ridge
        skin = torch.zeros(1, sum(BODY.cells), 3)
        skin[0, cell] = 2.0
        push = encoder(skin)[0].push.numpy()
        toward.append(PushDirection(BODY, "link")(push, np.zeros((1, 4)))[0, 1])
    np.testing.assert_allclose(toward[0] @ toward[1], 0.8**2 - 0.6**2, atol=1e-6)


@given(values=pushes, seed=st.integers(0, 99))
@settings(max_examples=20, deadline=None)
def test_one_patch_alone_is_seen_alike(values, seed):
    push = np.array(values, np.float32).reshape(1, 3, 3)
    q = postures(BODY, 1, seed)
    seen = PushDirection(BODY, "base")
    for patch, expected in enumerate(seen(push, q)[0]):
        np.testing.assert_allclose(seen.of_patch(patch, push[0, patch], q[0]), expected, atol=1e-6)
