"""Do the worlds behave as the authors' simulators?

Simulates Prison Escape with the detection factors of recorded reference episodes and with the sets' own (tuned to the paper's
rates), Narco with its own, and compares lengths, rates, gaps, strides and where episodes end. With --reference DIR, a folder
that holds low/, med/ and high/ with MCAP logs of the original simulator (and may hold low_extra.npz, for the replay step by
step), the reference comes from there; without it from the numbers kept in tests/cadence/worlds. --keep FILE writes the
reference's numbers.

    python -m benchmarks.worlds --reference ../shared/data/prison_reference --publish docs
"""

import argparse
import json
from pathlib import Path

import numpy as np

from benchmarks import publishing
from benchmarks.episode_statistics import EpisodeStatistics, compare, episode_statistics, site_difference
from benchmarks.publishing import Measurement
from cadence.recordings import Recordings
from cadence.worlds import narco, prison, prison_map
from cadence.worlds.draws import Draws
from cadence.worlds.prison_fugitive import Fugitives, Sight, stride
from pipeline.episodes.recordings import RecordingsConfig, load_recordings
from pipeline.progress import Progress

KEPT = Path(__file__).resolve().parents[1] / "tests" / "cadence" / "worlds" / "prison_reference.json"
REFERENCE_FACTORS = {"low": 3.5, "med": 6.4, "high": 8.3}
PAPER_RATES = {"low": 0.129, "med": 0.440, "high": 0.631}
NARCO_RATES = {"low": 0.138, "high": 0.315}
SITES = np.concatenate([prison_map.KNOWN_SITES, prison_map.UNKNOWN_SITES]) * prison_map.CELL_M
NUM_KNOWN = len(prison_map.KNOWN_SITES)
RADIUS_M = 50.5 * prison_map.CELL_M
STRIDES = (1.41, 5.0, 6.0, 7.07, 8.0)
"""Lengths of most strides, in cells: targets walk on whole cells."""
UNITS = {"length": "steps", "rate": None, "gap": "steps", "stride": "cells"}


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


def prison_tables(
    reference: dict[str, EpisodeStatistics], num_episodes: int, seed: int
) -> tuple[list[publishing.Row], list[publishing.Row]]:
    """What the original's episodes and ours are like, and how far ours with the same factor are from the original's."""
    rows, distances = [], []
    for name, item in reference.items():
        rows.append(describe(name, "original", REFERENCE_FACTORS[name], item))
        for factor in (REFERENCE_FACTORS[name], None):
            config = prison.PrisonConfig(set=name, factor=factor)
            ours = of_prison(prison.simulate_prison_batch(config, seed, np.arange(num_episodes)))
            rows.append(describe(name, "ours" if factor else "ours, tuned", config.detection_factor, ours))
            if factor is None:
                continue
            for measure, far in compare(ours, item).items():
                distances.append({
                    "set": name, "measure": measure, "largest_difference": far.largest, "area": far.area,
                    "unit": UNITS[measure], "chance": far.chance,
                })  # fmt: skip
            apart = site_difference(ours, item, len(SITES))
            distances.append({
                "set": name, "measure": "site of the end", "largest_difference": apart, "area": None, "unit": None,
                "chance": None,
            })  # fmt: skip
    return rows, distances


def describe(name: str, episodes: str, factor: float, item: EpisodeStatistics) -> publishing.Row:
    """Lengths, rates, gaps, strides, and how many episodes end at a hideout that the trackers know."""
    gaps, strides = np.percentile(item.gap, [50, 90]), np.rint(item.stride * 100) / 100
    shares = {f"stride_{f'{cells:g}'.replace('.', '_')}_percent": 100 * np.mean(strides == cells) for cells in STRIDES}
    return {
        "set": name, "episodes": episodes, "num_episodes": len(item.length), "detection_factor": factor,
        **mean_and_median("length_steps", item.length), **mean_and_median("rate_percent", 100 * item.rate),
        "gap_steps_median": gaps[0], "gap_steps_90": gaps[1], **shares,
        "ended_at_known_percent": 100 * item.share_at(0, NUM_KNOWN),
    }  # fmt: skip


def mean_and_median(column: str, values: np.ndarray) -> publishing.Row:
    """Both over episodes."""
    return {f"{column}_mean": values.mean(), f"{column}_median": np.median(values)}


def narco_table(num_episodes: int, seed: int) -> list[publishing.Row]:
    """What our episodes of the world narco are like."""
    sites = narco.HIDEOUTS * narco.UNIT_M
    rows = []
    for name, rate in NARCO_RATES.items():
        episodes = narco.simulate_narco_batch(narco.NarcoConfig(set=name), seed, np.arange(num_episodes))
        item = episode_statistics(episodes, narco.UNIT_M, sites, 50.5 * narco.UNIT_M)
        rows.append({
            "set": name, "paper_rate_percent": 100 * rate, **mean_and_median("rate_percent", 100 * item.rate),
            **mean_and_median("length_steps", item.length), "reached_hideout_percent": 100 * item.share_at(0, len(sites)),
        })  # fmt: skip
    return rows


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
    parser.add_argument("--publish", type=Path, metavar="DOCS", help="write numbers and section below this folder")
    arguments = parser.parse_args()
    reference = reference_statistics(arguments.reference, arguments.cache)
    if arguments.keep:
        keep(reference, arguments.keep)
    rows, distances = prison_tables(reference, arguments.episodes, arguments.seed)
    tables = {"worlds": rows, "worlds_distances": distances, "worlds_narco": narco_table(arguments.episodes, arguments.seed)}
    extra = arguments.reference / "low_extra.npz" if arguments.reference else None
    if extra is not None and extra.is_file():
        episodes, steps = replay(extra, arguments.episodes)
        same = {"exact_episodes_percent": 100 * episodes, "exact_steps_percent": 100 * steps}
        tables["worlds_replay"] = [{"num_episodes": arguments.episodes, **same}]
    publishing.publish(Measurement("worlds", publishing.facts_of("worlds"), tables), section, arguments.publish)


def section(measured: Measurement) -> str:
    """The original beside ours, set by set."""
    columns = {
        "length, steps": ("length_steps_mean", ".0f"), "detected, %": ("rate_percent_mean", ".1f"),
        "longest gaps, steps": ("gap_steps_90", ".0f"), "strides of 7.07 cells, %": ("stride_7_07_percent", ".1f"),
        "ended at a known site, %": ("ended_at_known_percent", ".1f"),
    }  # fmt: skip
    lines = []
    for original in measured.rows(episodes="original"):
        (ours,) = measured.rows(set=original["set"], episodes="ours")
        cells = [f"{original[name]:{digits}} / {ours[name]:{digits}}" for name, digits in columns.values()]
        lines.append([f"prison {original['set']}", *cells])
    rates = [
        f"{row['set']} {row['rate_percent_mean']:.1f} % (the paper: {row['paper_rate_percent']:.1f} %)"
        for row in measured.rows("narco")
    ]
    text = f"Detected in narco: {', '.join(rates)}."
    if "worlds_replay" in measured.tables:
        (same,) = measured.rows("replay")
        text += (
            f" Put in the place of recorded fugitives, ours does the same in {same['exact_steps_percent']:.1f} % of the steps "
            f"of {same['num_episodes']} episodes."
        )
    heads = ["original / ours", *columns]
    return f"{publishing.table(heads, lines)}\n\n{text}"


if __name__ == "__main__":
    main()
