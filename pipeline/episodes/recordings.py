"""Episodes as `Recordings`: a folder of mission logs with truth, or one of the paper's worlds.

What was read or simulated once is kept as npz in a cache folder: logs by their content, simulated episodes in blocks, so
that a killed call goes on where it was.
"""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from cadence.constraints.obstacles import Obstacles
from cadence.errors import CadenceError, InputError
from cadence.recordings import Recordings
from cadence.worlds.terrain import Terrain
from pipeline.config import config_as_dict
from pipeline.episodes.recorded_logs import Gridding, LogEpisodes, read_log_episodes
from pipeline.extract.config import ExtractConfig
from pipeline.files import hash_file, replacing
from pipeline.obstacle_file import as_obstacles, obstacles_as_json
from pipeline.progress import Progress
from pipeline.provenance import versions

BLOCK = 500
"""Simulated episodes a file of the cache."""

FORMAT = 1
"""Of the files in the cache."""

_READING = 2
"""Of what is read of a log: since 2 its targets may be one episode."""


@dataclass(frozen=True)
class RecordingsConfig:
    """Where episodes come from.

    data           a folder of MCAP logs with truth, or an npz of `save_recordings`; without it the world is simulated
    pattern        which files of that folder, as a glob below it
    world, set     what is simulated: "prison" with "low", "med" or "high", "narco" with "low" or "high", or "rendezvous",
                   which has no sets
    first_index, num_episodes  of the simulated episodes; each depends on the seed and its index alone
    seed           of the simulation
    step_s         seconds between steps of logs; by default what each log states, or else what its truth has
    max_gap_steps  truth and trackers of logs are interpolated between samples at most so far apart
    tolerance_m    detections of logs count as exact where they are no further than this from the truth
    scale_m        what distances are divided by; by default the longer side of the map, as logs state it
    extract        where truth, detections and trackers are in the logs
    """

    data: Path | None = None
    pattern: str = "**/*.mcap"
    world: Literal["prison", "narco", "rendezvous"] = "prison"
    set: Literal["low", "med", "high"] = "low"
    first_index: int = 0
    num_episodes: int = 50
    seed: int = 0
    step_s: float | None = None
    max_gap_steps: float = 2.0
    tolerance_m: float = 1.0
    scale_m: float | None = None
    extract: ExtractConfig = field(default_factory=ExtractConfig)

    def __post_init__(self) -> None:
        if self.num_episodes < 1 or min(self.first_index, self.seed) < 0:
            raise ValueError("num_episodes must be at least 1, first_index and seed not negative")
        if (self.world, self.set) == ("narco", "med"):
            raise ValueError("the world 'narco' has the sets 'low' and 'high'")
        if self.world == "rendezvous" and self.set != "low":
            raise ValueError("the world 'rendezvous' has no sets; leave set as it is")
        if any(value is not None and not value > 0 for value in (self.step_s, self.scale_m)):
            raise ValueError("step_s and scale_m must be positive")
        if self.max_gap_steps < 1 or self.tolerance_m < 0:
            raise ValueError("max_gap_steps must be at least 1, tolerance_m not negative")


@dataclass(frozen=True, eq=False)
class RecordingSet:
    """Episodes with what belongs to them.

    names      of the tracks [E]; targets of one log or episode are told apart by a suffix
    obstacles  of every track [E]; the same object where they are the same
    scale_m    what the paper divides distances by; None where nothing states it
    left_out   one line for each log that could not be used
    """

    recordings: Recordings
    names: tuple[str, ...]
    obstacles: tuple[Obstacles, ...]
    scale_m: float | None
    left_out: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not len(self.recordings) == len(self.names) == len(self.obstacles):
            raise ValueError("RecordingSet: as many names and obstacles as tracks are needed")


def load_recordings(config: RecordingsConfig, cache: Path, progress: Progress, together: bool = False) -> RecordingSet:
    """The episodes that `config` asks for, by way of the folder `cache`.

    With `together` all targets of a log are one episode; all logs need the same number of them then, recorded at the same
    steps. A log that cannot be used is named and left out. Raises `InputError` where none can be used.
    """
    if config.data is not None and config.data.suffix == ".npz":
        recordings, more = read_recordings(config.data)
        obstacles = as_obstacles(json.loads(str(more.get("obstacles", "[]"))))
        names = tuple(f"{config.data.stem}-{index:05d}" for index in range(len(recordings)))
        scale_m = config.scale_m or (float(more["scale_m"]) if "scale_m" in more else None)
        return RecordingSet(recordings, names, (obstacles,) * len(recordings), scale_m)
    if config.data is not None:
        return _of_logs(config.data, config, cache, progress, together)
    return _of_world(config, cache, progress)


def save_recordings(path: Path, recordings: Recordings, **more: Any) -> None:
    """Write episodes as npz, whole or not at all.

    `more` are further arrays: of those `load_recordings` knows scale_m and obstacles (the list of obstacles.json as text).
    """
    with replacing(path) as draft, draft.open("wb") as stream:
        np.savez_compressed(stream, **vars(recordings), **more, format=FORMAT)


def read_recordings(path: Path) -> tuple[Recordings, dict[str, Any]]:
    """What `save_recordings` wrote. `InputError` where the file is absent, damaged or of another format."""
    try:
        # An open file of our own: numpy does not close the one it opens where the archive is damaged.
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        if int(arrays.pop("format")) != FORMAT:
            raise ValueError("another format")
        own = {name: arrays.pop(name) for name in Recordings.__dataclass_fields__ if name != "num_agents"}
        num_agents = int(arrays.pop("num_agents", 1))
        return Recordings(**{**own, "step_s": float(own["step_s"])}, num_agents=num_agents), arrays
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise InputError(f"{path}: not readable episodes ({error}); remove the file, it is made again") from error
    except Exception as error:  # zipfile.BadZipFile and zlib.error, which share no base
        if type(error).__module__ not in ("zipfile", "zlib"):
            raise
        raise InputError(f"{path}: damaged ({error}); remove the file, it is made again") from error


def _of_logs(data: Path, config: RecordingsConfig, cache: Path, progress: Progress, together: bool) -> RecordingSet:
    if not data.is_dir():
        raise InputError(f"{data}: not a folder of MCAP logs with truth; check the path")
    logs = sorted(data.glob(config.pattern))
    if not logs:
        raise InputError(f"{data}: holds no log ({config.pattern}); give a folder of MCAP logs with truth")
    found: list[LogEpisodes] = []
    left_out: list[str] = []
    with progress.bar(len(logs), "read logs", unit="log") as bar:
        for log in logs:
            try:
                episodes = _of_log(log, config, cache)
                if found and episodes.recordings.step_s != found[0].recordings.step_s:
                    raise InputError(
                        f"{log}: a step of {episodes.recordings.step_s:g} s, the logs before it have "
                        f"{found[0].recordings.step_s:g} s; set step_s"
                    )
                if together:
                    _check_together(log, episodes, found)
                found.append(episodes)
            except CadenceError as error:
                left_out.append(str(error))
                progress.warn(f"left out: {error}")
            bar.update(1)
    if not found:
        many = f" ({len(left_out)} logs could not be used; this is the first)" if len(left_out) > 1 else ""
        raise InputError(f"{left_out[0]}{many}")
    shared = {text: as_obstacles(json.loads(text)) for text in {part.obstacles for part in found}}
    scales = [part.scale_m for part in found if np.isfinite(part.scale_m)]
    return RecordingSet(
        Recordings.concatenate([part.recordings if together else part.recordings.apart() for part in found]),
        tuple(name for part in found for name in part.names),
        tuple(shared[part.obstacles] for part in found for _ in part.names),
        config.scale_m or (scales[0] if scales and len(set(scales)) == 1 else None),
        tuple(left_out),
    )


def _check_together(log: Path, episodes: LogEpisodes, before: Sequence[LogEpisodes]) -> None:
    """`InputError` for a log whose targets are no episode like those before it."""
    count, size = len(episodes.names), episodes.recordings.num_agents
    if size != count:
        raise InputError(f"{log}: its {count} targets have truth at different steps; to draw them together they need the same")
    if before and size != before[0].recordings.num_agents:
        raise InputError(
            f"{log}: has {size} targets, the logs before it {before[0].recordings.num_agents}; to draw targets together "
            "give a folder or a pattern of logs with the same number"
        )


def _of_log(log: Path, config: RecordingsConfig, cache: Path) -> LogEpisodes:
    """The episodes of one log, from the cache where it has them."""
    gridding = Gridding(config.step_s, config.max_gap_steps, config.tolerance_m)
    key = [hash_file(log), config_as_dict(config.extract), config_as_dict(gridding), _READING]
    path = cache / "logs" / f"{_digest(key)}.npz"
    if path.is_file():
        recordings, more = read_recordings(path)
        names = tuple(log.stem + str(suffix) for suffix in more["suffixes"])
        return LogEpisodes(recordings, names, float(more["scale_m"]), str(more["obstacles"]))
    episodes = read_log_episodes(log, config.extract, gridding)
    suffixes = [name.removeprefix(log.stem) for name in episodes.names]
    save_recordings(path, episodes.recordings, suffixes=suffixes, scale_m=episodes.scale_m, obstacles=episodes.obstacles)
    return episodes


def _digest(key: object) -> str:
    text = json.dumps([key, versions(), FORMAT], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


@dataclass(frozen=True, eq=False)
class _World:
    """A world ready to be simulated: its settings, what gives the episodes of some indices, obstacles, the map's side."""

    config: object
    simulate: Callable[[Sequence[int]], Recordings]
    obstacles: Obstacles
    scale_m: float

    @staticmethod
    def on(terrain: Terrain, config: object, simulate: Callable[[Sequence[int]], Recordings]) -> "_World":
        """The world with the obstacles and the side of its terrain."""
        return _World(config, simulate, as_obstacles(obstacles_as_json(terrain)), terrain.side_m)


def _of_world(config: RecordingsConfig, cache: Path, progress: Progress) -> RecordingSet:
    """Simulated episodes, a block of indices after the other; blocks that are in the cache are not made again."""
    world = _world(config)
    stem = _world_stem(world, config)
    stop = config.first_index + config.num_episodes
    parts = []
    with progress.bar(config.num_episodes, f"{config.world} {config.set}", unit="episode") as bar:
        for begin in range(config.first_index // BLOCK * BLOCK, stop, BLOCK):
            first, last = max(begin, config.first_index), min(begin + BLOCK, stop)
            parts.append(_block(world, cache / "worlds", stem, begin, range(first, last)))
            bar.update(last - first)
    recordings = Recordings.concatenate(parts)
    episodes = [f"{config.world}-{config.set}-{config.seed}-{i:04d}" for i in range(config.first_index, stop)]
    agents = [f"-{agent}" for agent in range(recordings.num_agents)] if recordings.num_agents > 1 else [""]
    names = tuple(episode + agent for episode in episodes for agent in agents)
    return RecordingSet(recordings, names, (world.obstacles,) * len(names), config.scale_m or world.scale_m)


def _world_stem(world: _World, config: RecordingsConfig) -> str:
    """What the files of a world's episodes begin with."""
    # What the first episodes are stands for the world's code, which the settings do not know.
    sample = vars(world.simulate(range(4))).values()
    content = [hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest() for value in sample]
    key = _digest([config.world, config.seed, config_as_dict(world.config), content])[:12]
    return f"{config.world}-{config.set}-{config.seed}-{key}"


def _block(world: _World, folder: Path, stem: str, begin: int, wanted: range) -> Recordings:
    """The wanted episodes of the block that begins at index `begin`, from a file that holds them or newly simulated."""
    for path in sorted(folder.glob(f"{stem}-*.npz")):
        first, last = (int(text) for text in path.stem.rsplit("-", 2)[-2:])
        if begin <= first <= wanted.start and wanted.stop <= last:
            return read_recordings(path)[0].select(slice(wanted.start - first, wanted.stop - first))
    made = world.simulate(wanted)
    save_recordings(folder / f"{stem}-{wanted.start:06d}-{wanted.stop:06d}.npz", made)
    return made


def _world(config: RecordingsConfig) -> _World:
    """The world that `config` names."""
    if config.world == "rendezvous":
        from cadence.worlds.rendezvous import RendezvousConfig, simulate_rendezvous, simulate_rendezvous_batch

        rendezvous = RendezvousConfig()
        terrain = simulate_rendezvous(rendezvous, config.seed, 0).terrain
        return _World.on(
            terrain, rendezvous, lambda indices: simulate_rendezvous_batch(rendezvous, config.seed, indices).recordings
        )
    if config.world == "prison":
        from cadence.worlds.prison import PrisonConfig, simulate_prison, simulate_prison_batch

        prison = PrisonConfig(set=config.set)
        terrain = simulate_prison(prison, config.seed, 0).terrain
        return _World.on(terrain, prison, lambda indices: simulate_prison_batch(prison, config.seed, np.asarray(indices)))
    from cadence.worlds.narco import NarcoConfig, simulate_narco, simulate_narco_batch

    assert config.set != "med"  # refused by the configuration
    narco = NarcoConfig(set=config.set)
    terrain = simulate_narco(narco, config.seed, 0).terrain
    return _World.on(terrain, narco, lambda indices: simulate_narco_batch(narco, config.seed, np.asarray(indices)))
