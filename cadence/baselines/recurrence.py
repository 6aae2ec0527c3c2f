"""The recurrence of the VRNN over packed sequences, with its gradient written out.

Step by step through automatic differentiation most of the time goes into bookkeeping for small products. Here the gradients of
all weights are one product over all steps, and the loop keeps only what follows from one step to the next.
"""

import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from cadence.network.recurrent import run_in_float32

_MIN_SIGMA = 1e-4
"""Least standard deviation of a latent variable."""


def spread(raw: Tensor) -> Tensor:
    """Standard deviation from what the layers answer, any real number."""
    return torch.nn.functional.softplus(raw) + _MIN_SIGMA


def run_recurrence(
    of_features: Tensor, gates_of_features: Tensor, noise: Tensor, weights: tuple[Tensor, ...], sizes: list[int]
) -> tuple[Tensor, Tensor, Tensor]:
    """Posterior, latent variable and gated state, step by step; rows are packed: all first steps, all second ones, ...

    At each step, with the state s before it and numbers e of the noise:
    hidden = relu(P relu(f + s S_p) + p), (m, q) = hidden O + o, latent = m + spread(q) e, feature = relu(latent L + l),
    reset and update = sigmoid(g + feature G + s S_g), proposed = tanh(g + feature G + reset * (s S_g)),
    s' = (1 - update) proposed + update s; g has three parts for the three of them (Cho et al. 2014).

    Args:
        of_features: f [P, h].
        gates_of_features: g [P, 3 h].
        noise: e [P, z].
        weights: S [h, 4 h] (S_p and the three parts of S_g), P [h, h], p [h], O [h, 2 z], o [2 z], L [z, h], l [h], G [h, 3 h].
        sizes: rows at every step, not rising.

    Returns:
        (m, q) [P, 2 z], feature [P, h], s' [P, h].
    """
    apply: Callable[..., tuple[Tensor, Tensor, Tensor]] = functools.partial(_Recurrence.apply, sizes)
    return run_in_float32(apply, of_features, gates_of_features, noise, *weights)


class _Recurrence(torch.autograd.Function):
    """See `run_recurrence`."""

    @staticmethod
    def forward(ctx: Any, sizes: list[int], of_features: Tensor, of_gates: Tensor, noise: Tensor, *weights: Tensor) -> Any:
        by_state, by_hidden, hidden_bias, by_out, out_bias, by_latent, latent_bias, by_feature = weights
        p, h = of_features.shape
        z = noise.shape[1]
        first, hidden = torch.empty_like(of_features), torch.empty_like(of_features)
        moment, latent = of_features.new_empty(p, 2 * z), torch.empty_like(noise)
        feature, state, heard = (torch.empty_like(of_features) for _ in range(3))
        gates = of_gates.clone()
        before = of_features.new_zeros(sizes[0], h)
        begin = 0
        for size in sizes:
            here = slice(begin, begin + size)
            before = before[:size]
            from_state = before @ by_state
            torch.add(of_features[here], from_state[:, :h], out=first[here]).relu_()
            torch.addmm(hidden_bias, first[here], by_hidden, out=hidden[here])
            torch.addmm(out_bias, hidden[here].relu_(), by_out, out=moment[here])
            torch.addcmul(moment[here, :z], spread(moment[here, z:]), noise[here], out=latent[here])
            torch.addmm(latent_bias, latent[here], by_latent, out=feature[here])
            gate = gates[here]
            gate.addmm_(feature[here].relu_(), by_feature)
            gate[:, : 2 * h].add_(from_state[:, h : 3 * h]).sigmoid_()
            heard[here] = from_state[:, 3 * h :]
            gate[:, 2 * h :].addcmul_(gate[:, :h], heard[here]).tanh_()
            torch.lerp(gate[:, 2 * h :], before, gate[:, h : 2 * h], out=state[here])
            before = state[here]
            begin += size
        ctx.sizes = sizes
        ctx.save_for_backward(noise, first, hidden, moment, latent, feature, state, heard, gates, *weights)
        return moment, feature, state

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_moment: Tensor, d_feature: Tensor, d_state: Tensor) -> Any:
        noise, first, hidden, moment, latent, feature, state, heard, gates, *weights = ctx.saved_tensors
        by_state, by_hidden, by_out, by_latent, by_feature = (weights[i].t().contiguous() for i in (0, 1, 3, 5, 7))
        h, z = first.shape[1], noise.shape[1]
        sizes: list[int] = ctx.sizes
        before = torch.cat([state.new_zeros(sizes[0], h), state[previous_rows(sizes)]])
        slope = torch.cat([torch.ones_like(noise), noise * torch.sigmoid(moment[:, z:])], dim=1)
        d_moment = d_moment.clone()
        to_state = state.new_empty(len(state), 4 * h)  # of first, reset, update, heard
        to_gates = state.new_empty(len(state), 3 * h)
        to_feature, to_hidden = torch.empty_like(state), torch.empty_like(state)
        carried = state.new_zeros(sizes[0], h)
        end = len(state)
        for size in reversed(sizes):
            here = slice(end - size, end)
            reset, update, proposed = gates[here].chunk(3, dim=1)
            carry = carried[:size].add_(d_state[here])
            of_first, of_reset, of_update, of_heard = to_state[here].chunk(4, dim=1)
            gate = to_gates[here]
            torch.mul(carry, (before[here] - proposed) * (update * (1.0 - update)), out=of_update)
            torch.mul(carry - carry * update, 1.0 - proposed * proposed, out=gate[:, 2 * h :])
            torch.mul(gate[:, 2 * h :], reset, out=of_heard)
            torch.mul(of_heard * heard[here], 1.0 - reset, out=of_reset)
            gate[:, :h], gate[:, h : 2 * h] = of_reset, of_update
            torch.mul(torch.addmm(d_feature[here], gate, by_feature), feature[here] > 0, out=to_feature[here])
            d_moment[here] += slope[here] * (to_feature[here] @ by_latent).repeat(1, 2)
            torch.mul(d_moment[here] @ by_out, hidden[here] > 0, out=to_hidden[here])
            torch.mul(to_hidden[here] @ by_hidden, first[here] > 0, out=of_first)
            carry.mul_(update).addmm_(to_state[here], by_state)
            end -= size
        of_weights = (
            before.t() @ to_state,
            first.t() @ to_hidden,
            to_hidden.sum(0),
            hidden.t() @ d_moment,
            d_moment.sum(0),
            latent.t() @ to_feature,
            to_feature.sum(0),
            feature.t() @ to_gates,
        )
        return None, to_state[:, :h].clone(), to_gates, None, *of_weights


def previous_rows(sizes: list[int]) -> Tensor:
    """Where the row before lies, for every packed row from the second step on."""
    begins = torch.tensor([0, *sizes]).cumsum(0).tolist()
    parts = [torch.arange(begin, begin + size) for begin, size in zip(begins, sizes[1:], strict=False)]
    return torch.cat(parts) if parts else torch.zeros(0, dtype=torch.int64)
