"""What does it cost that agents see each other, from one agent to 32?

The shipped network of the world rendezvous draws 30 joint hypotheses for a window of A agents, once with its attention and once
with it switched off (every agent for itself). Processor time of one thread, both ways in turn in every round, the median round.

    python -m benchmarks.attention_cost --publish docs
"""

import argparse
import dataclasses
import statistics
import time
from pathlib import Path

import numpy as np
import torch

from benchmarks import publishing
from benchmarks.publishing import Measurement
from cadence.diffusion.place import PlaceModel
from cadence.recordings import ForecastWindows, cut_windows
from cadence.worlds.rendezvous import RendezvousConfig, simulate_rendezvous_batch
from pipeline.checkpoints import find_checkpoint
from pipeline.estimators.place import load_place_model

AGENTS = (1, 2, 4, 8, 16, 32)
NUM_HYPOTHESES = 30


def main() -> None:
    """Measure, print, publish."""
    options = _options()
    torch.set_num_threads(1)
    together = load_place_model(find_checkpoint(options.checkpoint))
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
    base = rows[0][2]
    table = [
        {"num_agents": agents, "alone": alone / base, "together": together / base, "together_over_alone": together / alone}
        for agents, together, alone in rows
    ]
    facts = publishing.facts_of("attention_cost") | {"num_rounds": options.rounds, "num_hypotheses": NUM_HYPOTHESES}
    publishing.publish(Measurement("attention_cost", facts, {"attention_cost": table}), section, options.publish)


def section(measured: Measurement) -> str:
    """How much longer all agents together take than every agent for itself."""
    words = [f"{row['together_over_alone']:.1f} ({row['num_agents']})" for row in measured.rows()]
    return f"All together take so many times as long as every agent for itself (agents): {', '.join(words)}."


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--checkpoint", default="rendezvous")
    parser.add_argument("--publish", type=Path, metavar="DOCS", help="write numbers and section below this folder")
    return parser.parse_args()


def _without_attention(model: PlaceModel) -> PlaceModel:
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


if __name__ == "__main__":
    main()
