"""Attention between agents: equivariance, absence, one agent, and both forms against plain loops."""

import dataclasses

import pytest
import torch
from torch import Tensor

from cadence.network.attention import MAX_AGENTS, AgentAttention, Team
from cadence.network.unet import UNet, UNetConfig

FORMS = ("joint", "paired")
CONFIG = UNetConfig(in_channels=3, width=8, multipliers=(1, 2), condition_size=5, pre_norm=True, activation="silu")


def attention(form: str) -> AgentAttention:
    torch.manual_seed(0)
    module = AgentAttention(16, 4, 8, form)  # type: ignore[arg-type]
    torch.nn.init.normal_(module.write.weight, std=0.3)
    return module.double().eval()


def states(b: int = 2, a: int = 3, k: int = 2, pieces: int = 5) -> Tensor:
    return torch.randn(b * a * k, 16, pieces, dtype=torch.float64, generator=torch.Generator().manual_seed(1))


def everybody(b: int, a: int, k: int) -> Team:
    return Team(torch.ones(b, a, dtype=torch.bool), k)


@pytest.mark.parametrize("form", FORMS)
def test_permuting_agents_permutes_the_answer(form: str) -> None:
    module, hidden = attention(form), states()
    is_present = torch.tensor([[True, True, True], [True, False, True]])
    order = [2, 0, 1]

    def permuted(rows: Tensor) -> Tensor:
        return rows.unflatten(0, (2, 3, 2))[:, order].flatten(0, 2)

    plain = module(hidden, Team(is_present, 2))
    again = module(permuted(hidden), Team(is_present[:, order], 2))
    assert torch.allclose(again, permuted(plain), atol=1e-12)
    assert not torch.allclose(plain, hidden, atol=1e-3)


@pytest.mark.parametrize("form", FORMS)
def test_the_network_is_equivariant_as_a_whole(form: str) -> None:
    torch.manual_seed(0)
    unet = UNet(dataclasses.replace(CONFIG, attention_heads=2, attention_form=form)).double().eval()  # type: ignore[arg-type]
    for parameter in unet.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    generator = torch.Generator().manual_seed(1)
    track = torch.randn(2 * 3, 3, 8, generator=generator, dtype=torch.float64)
    condition = torch.randn(2 * 3, 5, generator=generator, dtype=torch.float64)
    order = torch.tensor([1, 2, 0, 4, 5, 3])  # within each window of three
    team = everybody(2, 3, 1)
    plain = unet(track, condition, team)
    assert torch.allclose(unet(track[order], condition[order], team), plain[order], atol=1e-10)
    assert not torch.allclose(unet(track, condition), plain, atol=1e-3)  # they do see each other


@pytest.mark.parametrize("form", FORMS)
def test_absent_agents_are_seen_by_nobody_and_one_agent_is_the_single_target_model(form: str) -> None:
    module, hidden = attention(form), states(b=1, a=3, k=2)
    team = Team(torch.tensor([[True, True, False]]), 2)
    changed = hidden.clone()
    changed[4:] += 10.0  # the rows of the absent agent
    assert torch.equal(module(hidden, team)[:4], module(changed, team)[:4])
    # two of three present are two agents
    pair = module(hidden[:4], everybody(1, 2, 2))
    assert torch.allclose(module(hidden, team)[:4], pair, atol=1e-12)
    # nobody else: nothing is read
    alone = Team(torch.tensor([[False, True, False]]), 2)
    assert torch.equal(module(hidden, alone)[2:4], hidden[2:4])
    assert torch.equal(module(hidden[:2], everybody(1, 1, 2)), hidden[:2])


@pytest.mark.parametrize("form", FORMS)
def test_samples_see_the_sample_of_the_same_number_only(form: str) -> None:
    module, hidden = attention(form), states(b=1, a=2, k=3)
    changed = hidden.clone()
    changed[[1, 4]] += 1.0  # sample 1 of both agents
    before, after = (module(rows, everybody(1, 2, 3)) for rows in (hidden, changed))
    assert torch.equal(before[[0, 2, 3, 5]], after[[0, 2, 3, 5]])


@pytest.mark.parametrize("form", FORMS)
def test_both_forms_are_what_they_say(form: str) -> None:
    module, hidden = attention(form), states(b=1, a=3, k=1, pieces=2)
    query, key, value = module.read(module.norm(hidden)).reshape(3, 3, 4, 4, 2).unbind(1)  # [A, heads, C, P]
    expected = hidden.clone()
    for reader in range(3):
        read = torch.zeros(4, 4, 2, dtype=torch.float64)
        for head in range(4):
            for piece in range(2):
                logits, values, groups = [], [], []
                for other in (o for o in range(3) if o != reader):
                    for there in range(2):
                        logits.append((query[reader, head, :, piece] * key[other, head, :, there]).sum() / 2.0)
                        values.append(value[other, head, :, there])
                        groups.append(other)
                scores, names = torch.stack(logits), torch.tensor(groups)
                weight = torch.zeros(4, dtype=torch.float64)
                if form == "joint":
                    weight = scores.exp() / (scores.exp().sum() + 1.0)  # one stands for reading nothing
                else:
                    for other in names.unique():
                        weight[names == other] = scores[names == other].softmax(0)
                read[head, :, piece] = (weight[:, None] * torch.stack(values)).sum(0)
        expected[reader] += module.write(read.reshape(1, 16, 2))[0]
    assert torch.allclose(module(hidden, everybody(1, 3, 1)), expected, atol=1e-12)


def test_limits() -> None:
    with pytest.raises(ValueError, match=f"at most {MAX_AGENTS}"):
        everybody(1, MAX_AGENTS + 1, 1)
    with pytest.raises(ValueError, match="heads"):
        AgentAttention(16, 3, 8)
    with pytest.raises(ValueError, match="bool"):
        Team(torch.ones(1, 2))
