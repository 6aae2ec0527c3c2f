"""Do the worlds behave as the authors' simulators?

Simulates Prison Escape with the detection factors of recorded reference episodes and with the sets' own (tuned to the paper's
rates), Narco with its own, and compares lengths, rates, gaps, strides and where episodes end. With --reference DIR, a folder
that holds low/, med/ and high/ with MCAP logs of the original simulator (and may hold low_extra.npz, for the replay step by
step), the reference comes from there; without it from the numbers kept in tests/cadence. --publish DIR writes worlds.md there;
--keep FILE writes the reference's numbers.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np

from cadence.recordings import Recordings
from cadence.worlds import narco, prison, prison_map
from cadence.worlds.draws import Draws
from cadence.worlds.prison_fugitive import Fugitives, Sight, stride
from cadence.worlds.statistics import EpisodeStatistics, compare, episode_statistics, site_difference
from pipeline.episodes.recordings import RecordingsConfig, load_recordings
from pipeline.progress import Progress

KEPT = Path(__file__).resolve().parents[1] / "tests" / "cadence" / "prison_reference.json"
REFERENCE_FACTORS = {"low": 3.5, "med": 6.4, "high": 8.3}
PAPER_RATES = {"low": 0.129, "med": 0.440, "high": 0.631}
NARCO_RATES = {"low": 0.138, "high": 0.315}
SITES = np.concatenate([prison_map.KNOWN_SITES, prison_map.UNKNOWN_SITES]) * prison_map.CELL_M
NUM_KNOWN = len(prison_map.KNOWN_SITES)
RADIUS_M = 50.5 * prison_map.CELL_M
UNITS = {"length": "steps", "rate": "", "gap": "steps", "stride": "cells"}


def of_prison(recordings: Recordings) -> EpisodeStatistics:
    """Statistics in cells, with the twenty sites."""
    return episode_statistics(recordings, prison_map.CELL_M, SITES, RADIUS_M)


def kept_statistics(path: Path) -> dict[str, EpisodeStatistics]:
    """The reference's numbers out of their file."""
    found = {}
    for name, kept in json.loads(path.read_text()).items():
        gap, strides = (np.repeat(*np.array(kept[key]).T) for key in ("gap", "stride_squared"))
        found[name] = EpisodeStatistics(
            np.array(kept["length"], dtype=float),
            np.array(kept["rate"]),
            gap.astype(float),
            np.round(np.sqrt(strides), 3),
            np.array(kept["site"]),
        )
    return found


def keep(statistics: dict[str, EpisodeStatistics], path: Path) -> None:
    """Write numbers that `kept_statistics` reads: samples an episode, counts of gaps and of squared strides."""
    text = {}
    for name, item in statistics.items():
        counts = {"gap": np.unique(item.gap.astype(int), return_counts=True)}
        counts["stride_squared"] = np.unique(np.rint(item.stride**2).astype(int), return_counts=True)
        text[name] = {"length": item.length.astype(int).tolist(), "rate": np.round(item.rate, 4).tolist()}
        text[name] |= {"site": item.site.tolist()} | {key: np.stack(pair, axis=1).tolist() for key, pair in counts.items()}
    path.write_text(json.dumps(text, separators=(",", ":")) + "\n")


def reference_statistics(folder: Path | None, cache: Path) -> dict[str, EpisodeStatistics]:
    """By set: from logs, or as kept."""
    if folder is None:
        return kept_statistics(KEPT)
    found = {}
    for name in REFERENCE_FACTORS:
        config = RecordingsConfig(data=folder / name)
        found[name] = of_prison(load_recordings(config, cache, Progress(quiet=False)).recordings)
    return found


def both(values: np.ndarray, scale: float = 1.0, digits: int = 0) -> str:
    """Mean / median."""
    return f"{scale * values.mean():.{digits}f} / {scale * np.median(values):.{digits}f}"


def describe(item: EpisodeStatistics) -> str:
    """Cells of a table row: lengths, rates, gaps, strides, episodes that end at the known hideout."""
    gaps, strides = np.percentile(item.gap, [50, 90]), np.rint(item.stride * 100) / 100
    peaks = " ".join(f"{100 * np.mean(strides == value):.1f}" for value in (1.41, 5.0, 6.0, 7.07, 8.0))
    known = f"{100 * item.share_at(0, NUM_KNOWN):.1f}"
    return f"{both(item.length)} | {both(item.rate, 100, 1)} | {gaps[0]:.0f} / {gaps[1]:.0f} | {peaks} | {known}"


def prison_tables(reference: dict[str, EpisodeStatistics], num_episodes: int, seed: int) -> list[str]:
    """Lines of the tables of the world prison."""
    table = ["| episodes | factor | length | rate % | gap | strides % | known % |", "|---|---|---|---|---|---|---|"]
    apart = ["| set | measure | largest difference | area | chance |", "|---|---|---|---|---|"]
    for name, item in reference.items():
        table.append(f"| original, {name} ({len(item.length)}) | {REFERENCE_FACTORS[name]} | {describe(item)} |")
        for factor in (REFERENCE_FACTORS[name], None):
            config = prison.PrisonConfig(set=name, factor=factor)
            begin = time.perf_counter()
            ours = of_prison(prison.simulate_prison_batch(config, seed, np.arange(num_episodes)))
            speed = num_episodes / (time.perf_counter() - begin)
            print(f"{name}, factor {config.detection_factor}: {speed:.1f} episodes a second", flush=True)
            label = f"ours, {name}" if factor else f"ours, {name}, tuned to {100 * PAPER_RATES[name]:.1f} %"
            table.append(f"| {label} ({num_episodes}) | {config.detection_factor} | {describe(ours)} |")
            if factor is None:
                continue
            for measure, far in compare(ours, item).items():
                area = f"{far.area:.3g} {UNITS[measure]}".strip()
                apart.append(f"| {name} | {measure} | {far.largest:.3f} | {area} | {far.chance:.2g} |")
            apart.append(f"| {name} | site of the end | {site_difference(ours, item, len(SITES)):.3f} | | |")
    return [*table, "", *apart]


def narco_table(num_episodes: int, seed: int) -> list[str]:
    """Lines of the table of the world narco."""
    sites = narco.HIDEOUTS * narco.UNIT_M
    table = ["| set | paper's rate % | our rate % | length | reached a hideout % |", "|---|---|---|---|---|"]
    for name, rate in NARCO_RATES.items():
        episodes = narco.simulate_narco_batch(narco.NarcoConfig(set=name), seed, np.arange(num_episodes))
        item = episode_statistics(episodes, narco.UNIT_M, sites, 50.5 * narco.UNIT_M)
        cells = (f"{100 * rate:.1f}", both(item.rate, 100, 1), both(item.length), f"{100 * item.share_at(0, len(sites)):.1f}")
        table.append(f"| {name} | {' | '.join(cells)} |")
    return table


def replay(path: Path, num_episodes: int) -> tuple[float, float]:
    """Shares of episodes and of steps in which our fugitive, put among recorded trackers, does what the recorded one did."""
    kept = np.load(path)
    offset = kept["episode_offset"][: num_episodes + 1]
    length, longest = np.diff(offset), int(np.diff(offset).max())
    rows = np.minimum(offset[:-1] + np.arange(longest)[:, None], offset[1:] - 1)
    here, sees, speed = kept["xy"].astype(float)[rows], kept["fugitive_sees"][rows], kept["speed"].astype(float)[rows]
    trackers = np.concatenate([kept["heli_xy"], kept["party_xy"]], axis=1).astype(float)[rows]
    is_known, sites = kept["hideout_known"][:num_episodes], kept["hideout_xy"][:num_episodes].astype(float)
    cameras = kept["camera_xy"][:num_episodes, : int(kept["n_known_cameras"])].astype(float)
    fugitives = Fugitives(
        sites[~is_known].reshape(num_episodes, -1, 2),
        sites[is_known],
        cameras,
        kept["heli_xy"].shape[1],
        Draws(0, np.arange(num_episodes)),
    )
    num_wrong, is_mountain = np.zeros(num_episodes), prison_map.prison_map().is_mountain
    for step in range(longest - 1):
        some = np.flatnonzero(step + 1 < length)
        pace, heading = fugitives.act(some, Sight(step, here[step], speed[step], trackers[step], sees[step]))
        moved = stride(here[step, some], pace, heading)
        cell = moved.astype(int)
        moved = np.where(is_mountain[cell[:, 0], cell[:, 1]][:, None], here[step, some], moved)
        num_wrong[some] += (moved != here[step + 1, some]).any(axis=1)
    return float((num_wrong == 0).mean()), float(1 - num_wrong.sum() / (length - 1).sum())


def main() -> None:
    """Compare and print; write where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--reference", type=Path, help="folder of logs of the original simulator")
    parser.add_argument("--episodes", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cache", type=Path, default=Path("out/benchmarks/worlds"))
    parser.add_argument("--keep", type=Path, help="write the reference's numbers to this file")
    parser.add_argument("--publish", type=Path, help="write worlds.md into this folder")
    arguments = parser.parse_args()
    reference = reference_statistics(arguments.reference, arguments.cache)
    if arguments.keep:
        keep(reference, arguments.keep)
    lines = [
        *prison_tables(reference, arguments.episodes, arguments.seed),
        "",
        *narco_table(arguments.episodes, arguments.seed),
    ]
    extra = arguments.reference / "low_extra.npz" if arguments.reference else None
    if extra is not None and extra.is_file():
        episodes, steps = replay(extra, arguments.episodes)
        lines += ["", f"Replay of {arguments.episodes} recorded episodes: {100 * episodes:.1f} % of them exact in every step, "]
        lines[-1] += f"{100 * steps:.2f} % of the steps."
    print("\n".join(lines))
    if arguments.publish:
        (arguments.publish / "worlds.md").write_text(page(lines, arguments))


def page(lines: list[str], arguments: argparse.Namespace) -> str:
    """The page with its words."""
    command = f"benchmarks/worlds.py --reference DIR --episodes {arguments.episodes} --seed {arguments.seed}"
    rates = " / ".join(f"{100 * rate:.1f}" for rate in PAPER_RATES.values())
    factors = " / ".join(str(factor) for factor in REFERENCE_FACTORS.values())
    return WORDS.format(rates=rates, factors=factors, num=arguments.episodes, tables="\n".join(lines), command=command)


WORDS = """# Do the worlds behave as the authors' simulators?

Prison Escape: the original's recorded episodes (authors' configuration and policies, factors {factors}) beside ours with the
same factors, and with the factors of our sets, which are tuned to the paper's mean rates ({rates} %). Ours are other
episodes: other starts, hideouts and random numbers. Narco: no recorded episodes exist, only the paper's rates.

* length, rate: mean / median over episodes, of steps and of the share of steps with a detection.
* gap: median / 90th percentile of the steps between detections that do not follow each other.
* strides: share of steps of 1.41, 5, 6, 7.07 and 8 cells; targets walk on whole cells.
* known: share of episodes that end at the hideout known to the trackers.

{tables}

* largest difference: between the two distribution functions (Kolmogorov–Smirnov); area: between them (Wasserstein distance).
* chance: of so large a difference were both the same and all values independent. Gaps and strides of one episode are not,
  so that for them it is far too small.
* site of the end: total variation distance over the 20 sites; two samples of 300 from one distribution differ by about 0.1.

A recorded step is replayed by putting our fugitive where the recorded one was, among its trackers, with what it saw. It
departs where the original draws a random block to plan from (in the shadow of the mountain on its planning grid), and stays
off until it plans anew.

Made by `{command} --publish docs/benchmarks`. Means of rates over 300 episodes have a standard error of about 1.4 points.
"""


if __name__ == "__main__":
    main()
