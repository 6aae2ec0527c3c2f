"""What does it cost that agents see each other, from one agent to 32?

The shipped network of the world rendezvous draws 30 joint hypotheses for a window of A agents, once with its attention and once
with it switched off (every agent for itself). Processor time of one thread, both ways in turn in every round, the median round.

    python benchmarks/attention_cost.py --publish docs/benchmarks
"""

import argparse
import dataclasses
import statistics
import time
from pathlib import Path

import numpy as np
import torch

from cadence.diffusion.scene import SceneModel
from cadence.recordings import ForecastWindows, cut_windows
from cadence.worlds.rendezvous import RendezvousConfig, simulate_rendezvous_batch
from pipeline.checkpoints import find_checkpoint
from pipeline.estimators.scene import load_scene
from pipeline.files import write_atomic

AGENTS = (1, 2, 4, 8, 16, 32)
NUM_HYPOTHESES = 30


def main() -> None:
    """Measure, print, publish."""
    options = _options()
    torch.set_num_threads(1)
    together = load_scene(find_checkpoint(options.checkpoint))
    alone = _without_attention(together)
    rows = []
    for agents in AGENTS:
        windows = _windows(agents)
        times: dict[str, list[float]] = {"together": [], "alone": []}
        for number in range(options.rounds + 1):
            for name, model in (("together", together), ("alone", alone)):
                begun = time.process_time()
                model.sample(windows.windows, NUM_HYPOTHESES)
                if number:  # the first round warms up
                    times[name].append(time.process_time() - begun)
        rows.append((agents, *(statistics.median(times[name]) for name in ("together", "alone"))))
    page = _render(rows, options.rounds)
    print(page)
    if options.publish is not None:
        write_atomic(options.publish / "attention_cost.md", page)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--checkpoint", default="rendezvous")
    parser.add_argument("--publish", type=Path, metavar="DIR", help="write attention_cost.md there")
    return parser.parse_args()


def _without_attention(model: SceneModel) -> SceneModel:
    """The same weights, with agents that do not see each other."""
    config = dataclasses.replace(model.config, network=dataclasses.replace(model.config.network, attention_heads=0))
    network = config.build()
    wanted = network.state_dict().keys()
    network.load_state_dict({name: value for name, value in model.network.state_dict().items() if name in wanted})
    return dataclasses.replace(model, network=network.eval(), config=config)


def _windows(agents: int) -> ForecastWindows:
    """One window in the middle of an episode of so many agents, all detected before."""
    episodes = simulate_rendezvous_batch(RendezvousConfig(num_agents=agents), 7, np.arange(1))
    return cut_windows(episodes.recordings, np.array([0]), episodes.length[:1] // 2)


def _render(rows: list[tuple[int, float, float]], rounds: int) -> str:
    base = rows[0][2]
    lines = [
        "# What attention between agents costs",
        "",
        f"Made by `python benchmarks/attention_cost.py --publish docs/benchmarks`: {NUM_HYPOTHESES} joint hypotheses for one",
        f"window of A agents, six steps of DPM-Solver++, one thread, median of {rounds} rounds. Times over that of one agent.",
        "",
        "| agents | every agent for itself | all together | together over alone |",
        "|---|---|---|---|",
        *(
            f"| {agents} | {alone / base:.2f} | {together / base:.2f} | {together / alone:.2f} |"
            for agents, together, alone in rows
        ),
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
