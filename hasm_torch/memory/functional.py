"""The memory as functions of plain tensors, with leading batch dimensions everywhere.

    m = s ⊗ RoPE3D(o; n, θ)        associate      (section "Association Creation")
    d = S₋₁ f(β Mᵀ q)              recall         (section "Hetero-associative Sequential Memory")

A memory per sample (fast weights) is M = associate(s, o) of shape (batch, rows, code_dim), read by
``recall`` with a query of the same leading dimension.
"""

from torch import Tensor

from hasm_torch.encoders.bipolar import bind
from hasm_torch.encoders.rope3d import rope3d
from hasm_torch.memory.recall import Interaction, Stored, check_interaction, recall_dense


def associate(
    state: Tensor,
    observation: Tensor,
    axis: Tensor | None = None,
    angle: Tensor | None = None,
) -> Tensor:
    """Bind a state to an observation that is rotated by the touch.

    Args:
        state: s, (..., code_dim).
        observation: o, (..., code_dim).
        axis: n, rotation axis of the touch, (..., 3); without it nothing is rotated.
        angle: θ, rotation angle of the touch, (...,), rad.

    Returns:
        m or q, (..., code_dim).

    Raises:
        ValueError: If the codes differ in length, or only one of axis and angle is given.
    """
    if state.shape[-1] != observation.shape[-1]:
        raise ValueError(
            f"expected codes of one length, got state {tuple(state.shape)} and observation "
            f"{tuple(observation.shape)}"
        )
    if (axis is None) != (angle is None):
        raise ValueError("axis and angle describe one rotation: give both or neither")
    if axis is not None and angle is not None:
        observation = rope3d(observation, axis, angle)
    return bind(state, observation)


def recall(
    query: Tensor,
    associations: Tensor,
    successors: Tensor,
    beta: float | Tensor = 1.0,
    mask: Tensor | None = None,
    interaction: Interaction = "softmax",
    top_k: int | None = None,
) -> Tensor:
    """Recall the decision for queries.

    Args:
        query: q, (*batch, ..., code_dim).
        associations: M, (*batch, rows, code_dim); without ``batch`` one memory for all queries.
        successors: S₋₁, (*batch, rows, value_dim).
        beta: β, a number or a () tensor.
        mask: Rows that each query may recall, (*batch, ..., rows) bool.
        interaction: How a match becomes a weight, see ``HeteroAssociativeMemory``.
        top_k: Best matches that weigh; None for all.

    Returns:
        d, (*batch, ..., value_dim); differentiable in query, associations, successors and β.

    Raises:
        ValueError: If the shapes do not fit, or an option is unknown.
    """
    check_interaction(interaction, top_k)
    memory = Stored(associations, successors, beta, None, mask, interaction, top_k)
    return recall_dense(query, memory)
