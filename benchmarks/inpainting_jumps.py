"""Do detections that are put into samples of an absolute-coordinate network make jumps?

A small network is trained on the patrol simulator (past and future in one window) and samples windows of other episodes, with
every way of inpainting. Steps between a known and an unknown cell are the edges where overwriting jumps; the past between
detections tells whether the way of inpainting also helps. The training is kept in the work folder and goes on after a kill.

    nice -n 10 python benchmarks/inpainting_jumps.py --publish docs/benchmarks
"""

import argparse
import dataclasses
import sys
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from cadence.bank.rows import active_rows
from cadence.diffusion.absolute import AbsoluteModel, AbsoluteSampling
from cadence.diffusion.inpainting import grid_detections, known_cells
from cadence.metrics import bootstrap_mean
from cadence.network.trajectory import TrajectoryNetworkConfig
from cadence.training.loop import OptimiserConfig
from cadence.types import Context
from cadence.worlds.patrol import PatrolConfig, simulate_patrol
from pipeline.estimators.paper import load_absolute
from pipeline.files import write_atomic
from pipeline.progress import Progress
from pipeline.train.config import AbsoluteTraining, TrainConfig
from pipeline.train.missions import mission_of_episode
from pipeline.train.paper import draw_windows
from pipeline.train.stage import train

WORK = Path("out/benchmarks/inpainting_jumps")
TEST_SEED = 900_001
MODES = ("none", "overwrite", "noise_matched", "smoother")
NETWORK = TrajectoryNetworkConfig(
    num_steps=64, prediction="v", width=16, multipliers=(1, 2, 4), num_blocks=1, kernel_size=5, activation="silu", pre_norm=True
)
TRAINING = AbsoluteTraining(
    network=NETWORK, history_steps=48, context_steps=96, parked_tail=False, num_windows=48, num_episodes=60,
    num_validation_episodes=4, patrol=PatrolConfig(duration_s=14_400.0, step_s=30.0, detection_rate=0.15),
)  # fmt: skip


@dataclasses.dataclass(frozen=True, eq=False)
class Test:
    """Test windows of one agent each: truth [B, T, 2], cells that were seen and steps with truth [B, T], episode [B]."""

    model: AbsoluteModel
    batches: list[tuple[object, Tensor]]
    truth: Tensor
    is_seen: Tensor
    is_known: Tensor
    episode: Tensor


def trained(work: Path, seed: int, num_steps: int) -> AbsoluteModel:
    """The network, trained unless the work folder holds it."""
    config = TrainConfig(
        preset="paper", seed=seed, batch_size=64, validate_every=200, save_every=100, threads=1, paper=TRAINING,
        optimiser=OptimiserConfig(learning_rate=2e-3, num_steps=num_steps, warm_up_steps=50, ema_decay=0.99),
    )  # fmt: skip
    train(work, config, Progress())
    return load_absolute(work / "checkpoint.safetensors")


def test_windows(model: AbsoluteModel, num_episodes: int) -> Test:
    """Windows of episodes that no training has seen."""
    config = dataclasses.replace(TRAINING, num_windows=12)
    batches, truth, seen, known, episode = [], [], [], [], []
    for index in range(num_episodes):
        simulated = simulate_patrol(TRAINING.patrol, np.random.default_rng([TEST_SEED, index]))
        mission = mission_of_episode(simulated, str(index))
        if mission.detections.num_rows == 0:
            continue
        drawn = draw_windows(mission, config, model.config, index)
        batch, datum = drawn.windows.batch, torch.from_numpy(drawn.windows.datum_m)
        keep = (batch.is_active[:, 0] & drawn.is_known[:, 0].all(-1)).nonzero()[:, 0]
        if len(keep) == 0:
            continue
        nodes, _ = active_rows(batch[keep])
        at = nodes.time_s / model.config.step_s + model.config.history_steps - 1
        found = grid_detections(at, nodes.position_m, nodes.covariance_m2, nodes.is_observed, NETWORK.num_steps)
        batches.append((batch[keep], datum[keep]))
        truth.append(drawn.truth_m[keep, 0])
        seen.append(known_cells(found).is_known)
        known.append(drawn.is_known[keep, 0])
        episode.append(torch.full((len(keep),), index))
    return Test(model, batches, *(torch.cat(parts) for parts in (truth, seen, known, episode)))


def sampled(test: Test, sampling: AbsoluteSampling, num_hypotheses: int) -> Tensor:
    """Hypotheses [B, K, T, 2] of all test windows."""
    model = dataclasses.replace(test.model, sampling=sampling)
    windows = (batch.with_context(Context(datum)) for batch, datum in test.batches)
    parts = [model.sample(batch, num_hypotheses).position_m[:, :, 0] for batch in windows]
    return torch.cat(parts)


def row(name: str, position: Tensor, test: Test, history: int) -> str:
    """One line of the table."""
    step = (position[:, :, 1:] - position[:, :, :-1]).norm(dim=-1)
    is_edge = (test.is_seen[:, 1:] != test.is_seen[:, :-1])[:, None].expand(step.shape)
    is_inside = (test.is_seen[:, 1:] & test.is_seen[:, :-1])[:, None].expand(step.shape)
    is_elsewhere = ~is_edge & ~is_inside
    is_elsewhere[:, :, history - 1 :] = False
    lengths = [f"{step[mask].mean():.0f} / {step[mask].quantile(0.95):.0f}" for mask in (is_edge, is_inside, is_elsewhere)]
    error = (position - test.truth[:, None]).norm(dim=-1).mean(dim=1)
    rng = np.random.default_rng(0)
    scores = []
    # in reach of a detection: the past no more than eight steps from one
    near = torch.nn.functional.max_pool1d(test.is_seen[:, None].float(), 17, 1, 8)[:, 0] > 0
    past = torch.arange(error.shape[1]) < history
    for mask in (test.is_seen, past & ~test.is_seen & near, past & ~test.is_seen, ~past & ~test.is_seen):
        count = mask.sum(dim=1).double()
        value = torch.where(count > 0, (error * mask).sum(dim=1) / count, torch.nan)
        found = bootstrap_mean(value.numpy(), test.episode.numpy(), rng)
        scores.append(f"{found.value:.0f} [{found.low:.0f}, {found.high:.0f}]")
    return f"| {name} | " + " | ".join([*lengths, *scores]) + " |"


def main() -> None:
    """Train, sample, print and publish."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=WORK)
    parser.add_argument("--publish", type=Path, help="folder for inpainting.md")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=1500, help="of training")
    parser.add_argument("--episodes", type=int, default=24, help="to test on")
    parser.add_argument("--hypotheses", type=int, default=8)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    model = trained(arguments.work, arguments.seed, arguments.steps)
    test = test_windows(model, arguments.episodes)
    history = model.config.history_steps
    head = (
        "step at edges | between known cells | elsewhere in the past | error where seen | past, 8 steps around | past | future"
    )
    lines = [f"| sampler, inpainting | {head} |", "|---" * 8 + "|", row("truth", test.truth[:, None], test, history)]
    for sampler, num_steps, num in (("dpmpp", 10, arguments.hypotheses), ("ddpm", 100, max(2, arguments.hypotheses // 4))):
        for mode in MODES:
            position = sampled(test, AbsoluteSampling(sampler, num_steps, mode), num)
            lines.append(row(f"{sampler}-{num_steps}, {mode}", position, test, history))
            print(lines[-1], flush=True)
    command = f"python benchmarks/inpainting_jumps.py --seed {arguments.seed} --steps {arguments.steps}"
    command += f" --episodes {arguments.episodes} --hypotheses {arguments.hypotheses}"
    num_windows, num_episodes = len(test.truth), len(test.episode.unique())
    text = TEXT.format(command=command, table="\n".join(lines), num_windows=num_windows, num_episodes=num_episodes)
    sys.stdout.write(text)
    if arguments.publish is not None:
        write_atomic(arguments.publish / "inpainting.md", text)


TEXT = """# Inpainting in absolute coordinates: does it jump?

    {command}

A small absolute-coordinate network (past and future in one window of 48 + 16 steps of 60 s, v-prediction) trained for a few
CPU minutes on the patrol simulator, then {num_windows} windows of {num_episodes} other episodes. Metres.

Steps: mean / 95 % quantile of the step length at the edges (between a cell with a detection and one without), between two
cells with detections, and elsewhere in the past. Errors: mean distance of the hypotheses from the truth where something was
seen, in the past within eight steps of a detection, in the whole unseen past, and in the future; 95 % intervals by bootstrap
over episodes.

{table}

`overwrite` is the paper's way, `noise_matched` that of RePaint, `smoother` the default for networks in absolute coordinates.
The network is far from trained out: compare the ways with one another, not with other tables.
"""


if __name__ == "__main__":
    main()
