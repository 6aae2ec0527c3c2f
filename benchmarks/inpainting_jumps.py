"""Do detections that are put into samples of an absolute-coordinate network make jumps?

A small network is trained on the patrol simulator (past and future in one window) and samples windows of other episodes, with
every way of inpainting. Steps between a known and an unknown cell are the edges where overwriting jumps; the past between
detections tells whether the way of inpainting also helps. The training is kept in the work folder and goes on after a kill.

    nice -n 10 python -m benchmarks.inpainting_jumps --publish docs
"""

import argparse
import dataclasses
import sys
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks import publishing
from benchmarks.publishing import Measurement
from cadence.bank.rows import active_rows
from cadence.diffusion.absolute import AbsoluteModel
from cadence.diffusion.inpainting import grid_detections, known_cells
from cadence.diffusion.settings import AbsoluteSampling
from cadence.metrics import bootstrap_mean
from cadence.network.trajectory import TrajectoryNetworkConfig
from cadence.training.loop import OptimiserConfig
from cadence.types import Context
from cadence.worlds.patrol import PatrolConfig, simulate_patrol
from pipeline.estimators.paper import load_absolute
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


def row(position: Tensor, test: Test, history: int) -> publishing.Row:
    """Lengths of steps (mean, and that which 95 % do not exceed) and errors, metres."""
    step = (position[:, :, 1:] - position[:, :, :-1]).norm(dim=-1)
    is_edge = (test.is_seen[:, 1:] != test.is_seen[:, :-1])[:, None].expand(step.shape)
    is_inside = (test.is_seen[:, 1:] & test.is_seen[:, :-1])[:, None].expand(step.shape)
    is_elsewhere = ~is_edge & ~is_inside
    is_elsewhere[:, :, history - 1 :] = False
    found: publishing.Row = {}
    for name, mask in (("at_edges", is_edge), ("between_known", is_inside), ("elsewhere", is_elsewhere)):
        found |= {f"step_{name}_m_mean": float(step[mask].mean()), f"step_{name}_m_95": float(step[mask].quantile(0.95))}
    error = (position - test.truth[:, None]).norm(dim=-1).mean(dim=1)
    rng = np.random.default_rng(0)
    # in reach of a detection: the past no more than eight steps from one
    near = torch.nn.functional.max_pool1d(test.is_seen[:, None].float(), 17, 1, 8)[:, 0] > 0
    past = torch.arange(error.shape[1]) < history
    parts = {
        "where_seen": test.is_seen, "near_seen": past & ~test.is_seen & near, "past": past & ~test.is_seen,
        "future": ~past & ~test.is_seen,
    }  # fmt: skip
    for name, mask in parts.items():
        count = mask.sum(dim=1).double()
        value = torch.where(count > 0, (error * mask).sum(dim=1) / count, torch.nan)
        found |= publishing.columns(f"error_{name}_m", bootstrap_mean(value.numpy(), test.episode.numpy(), rng))
    return found


def section(measured: Measurement) -> str:
    """Steps at the edges, and errors near detections."""
    (truth,) = measured.rows(sampler="truth")
    words = []
    for mode in MODES[1:]:
        (row,) = measured.rows(sampler="ddpm-100", inpainting=mode)
        words.append(f"{row['step_at_edges_m_mean']:.0f} m and {row['error_near_seen_m']:.0f} m ({mode})")
    return (
        f"A small trained network, mean step at the edges and error within eight steps of a detection: {', '.join(words)}; "
        f"true steps there are {truth['step_at_edges_m_mean']:.0f} m long."
    )


def main() -> None:
    """Train, sample, print and publish."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=WORK)
    parser.add_argument("--publish", type=Path, metavar="DOCS", help="write numbers and section below this folder")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=1500, help="of training")
    parser.add_argument("--episodes", type=int, default=24, help="to test on")
    parser.add_argument("--hypotheses", type=int, default=8)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    model = trained(arguments.work, arguments.seed, arguments.steps)
    test = test_windows(model, arguments.episodes)
    history = model.config.history_steps
    rows = [{"sampler": "truth", "inpainting": None, **row(test.truth[:, None], test, history)}]
    for sampler, num_steps, num in (("dpmpp", 10, arguments.hypotheses), ("ddpm", 100, max(2, arguments.hypotheses // 4))):
        for mode in MODES:
            position = sampled(test, AbsoluteSampling(sampler, num_steps, mode), num)
            rows.append({"sampler": f"{sampler}-{num_steps}", "inpainting": mode, **row(position, test, history)})
            print(f"{sampler}-{num_steps}, {mode}", file=sys.stderr, flush=True)
    facts = publishing.facts_of("inpainting_jumps")
    facts |= {"num_windows": len(test.truth), "num_episodes": len(test.episode.unique())}
    publishing.publish(Measurement("inpainting_jumps", facts, {"inpainting_jumps": rows}), section, arguments.publish)


if __name__ == "__main__":
    main()
