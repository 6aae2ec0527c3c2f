"""Pictures of the paper's worlds: the map, many episodes, and what is known of the places.

python -m benchmarks.world_pictures --publish docs/images
"""

import argparse
import io
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon
from PIL import Image

from cadence.recordings import Recordings
from cadence.worlds import narco, ocean, prison, prison_map, rendezvous, rendezvous_map

NUM_EPISODES = 100
_INK, _SEEN, _CAUGHT, _GOAL, _VIA = "#1d2733", "#e8a33d", "#c0392b", "#2e7d32", "#6a4c93"


def draw_tracks(axes: Axes, episodes: Recordings, unit_m: float) -> None:
    """All targets' tracks, and where they were detected."""
    place = episodes.position_m / unit_m
    for begin, end in zip(episodes.offset[:-1], episodes.offset[1:], strict=True):
        axes.plot(*place[begin:end].T, color=_INK, lw=0.7, alpha=0.3)
    axes.plot(*place[episodes.is_detected].T, ".", color=_SEEN, ms=5, alpha=0.04, mew=0)
    axes.plot([], [], color=_INK, lw=1, label=f"{len(episodes)} tracks")
    axes.plot([], [], ".", color=_SEEN, ms=6, label=f"detections ({episodes.rates().mean():.1%} of the steps)")


def draw_narco() -> Figure:
    """Waves of the first chart, land, the ways by the rendezvous to the hideouts, and where vessels caught somebody."""
    sea = ocean.eastern_pacific()
    episodes = narco.simulate_narco_batch(narco.NarcoConfig("low"), 0, np.arange(NUM_EPISODES))
    figure, axes = plt.subplots(figsize=(9.0, 4.2), layout="constrained")
    waves = np.where(sea.is_land, np.nan, sea.wave[0]).T
    axes.set_facecolor("#d9d2c0")
    shown = axes.imshow(waves, origin="lower", extent=(0, ocean.SIZE[0], 0, ocean.SIZE[1]), cmap="Blues", vmin=0.5, vmax=5.0)
    figure.colorbar(shown, ax=axes, label="wave height [m], first chart", shrink=0.75)
    draw_tracks(axes, episodes, narco.UNIT_M)
    last = episodes.position_m[episodes.offset[1:] - 1] / narco.UNIT_M
    caught = np.hypot(*np.moveaxis(last[:, None] - narco.HIDEOUTS, -1, 0)).min(axis=1) > 50.0
    axes.plot(*last[caught].T, "x", color=_CAUGHT, ms=5, label=f"caught ({int(caught.sum())})")
    axes.plot(*narco.START, "o", color=_INK, ms=6, label="start")
    axes.plot(*narco.RENDEZVOUS.T, "D", color=_VIA, ms=5, label="rendezvous")
    axes.plot(*narco.HIDEOUTS.T, "*", color=_GOAL, ms=11, label="hideouts")
    axes.set(xlabel="east [km]", ylabel="north [km]", title="World narco, set low: eastern Pacific off Central America")
    axes.set(xlim=(0, ocean.SIZE[0]), ylim=(0, ocean.SIZE[1]))
    axes.legend(loc="lower left", fontsize=7, ncols=2)
    return figure


def draw_prison() -> Figure:
    """Coverage, the mountain, cameras, the sites of hideouts, and the ways of the fugitive."""
    ground = prison_map.prison_map()
    episodes = prison.simulate_prison_batch(prison.PrisonConfig("low"), 0, np.arange(NUM_EPISODES))
    figure, axes = plt.subplots(figsize=(8.2, 7.5), layout="constrained")
    side = prison_map.SIDE
    # A quarter of the cells and a dozen shades are enough for the eye, and keep the file small.
    coverage = np.where(ground.is_mountain, np.nan, ground.coverage)[::4, ::4].T
    axes.set_facecolor("#8d8478")
    shades = plt.get_cmap("YlGn_r", 12)
    shown = axes.imshow(coverage, origin="lower", extent=(0, side, 0, side), cmap=shades, vmin=0.0, vmax=0.8, alpha=0.8)
    figure.colorbar(shown, ax=axes, label="coverage: factor on detection ranges", shrink=0.75)
    draw_tracks(axes, episodes, prison_map.CELL_M)
    axes.add_patch(Circle(prison_map.MOUNTAIN, prison_map.KEEP_OUT, fill=False, ec=_INK, ls=":", lw=1.2))
    axes.plot(*prison_map.SEEN_CAMERAS.T, "^", color=_INK, ms=4, label="cameras the fugitive knows")
    axes.plot(*prison_map.HIDDEN_CAMERAS.T, "^", color=_CAUGHT, ms=4, label="cameras it does not know")
    axes.plot(*prison_map.UNKNOWN_SITES.T, "*", color=_GOAL, mec="white", mew=0.6, ms=12, label="hideouts")
    axes.plot(*prison_map.KNOWN_SITES.T, "D", color=_VIA, mec="white", mew=0.6, ms=6, label="hideouts, known to trackers")
    axes.set(xlabel="east [cells of 21 m]", ylabel="north [cells of 21 m]", title="World prison, set low")
    axes.set(xlim=(0, side), ylim=(0, side))
    figure.legend(loc="outside lower center", fontsize=8, ncols=3)
    return figure


def draw_rendezvous() -> Figure:
    """Cover, mountains, goals and sites; many tracks, and beside them one episode with a meeting and one without."""
    place = rendezvous_map.ground()
    joint = rendezvous.simulate_rendezvous_batch(rendezvous.RendezvousConfig(), 0, np.arange(NUM_EPISODES))
    figure, plots = plt.subplots(1, 3, figsize=(13.0, 5.0), layout="constrained", sharey=True)
    meeting, direct = (int(np.flatnonzero(joint.is_meeting == wanted)[2]) for wanted in (True, False))
    half = rendezvous_map.SIDE_M / 2000.0
    for axes in plots:
        axes.imshow(place.cover, origin="lower", extent=(-half, half, -half, half), cmap=plt.get_cmap("YlGn", 12), alpha=0.8)
        for polygon in place.terrain.polygons_m:
            axes.add_patch(Polygon(polygon / 1000.0, fc="#8d8478", ec=_INK, lw=0.6))
        for x, y, radius in place.terrain.circles_m / 1000.0:
            axes.add_patch(Circle((x, y), radius, fc="#8d8478", ec=_INK, lw=0.6))
        axes.plot(*rendezvous_map.GOALS_M.T / 1000.0, "*", color=_GOAL, mec="white", mew=0.6, ms=13, label="goals")
        axes.plot(*rendezvous_map.SITES_M.T / 1000.0, "D", color=_VIA, mec="white", mew=0.6, ms=7, label="meeting sites")
        axes.set(xlabel="east [km]", xlim=(-half, half), ylim=(-half, half))
    draw_tracks(plots[0], joint.recordings, 1000.0)
    titles = ("World rendezvous: cover and tracks", "An episode with a meeting", "An episode without")
    plots[0].set(ylabel="north [km]")
    for axes, title, episode in zip(plots, titles, (None, meeting, direct), strict=True):
        axes.set_title(title, fontsize=10)
        if episode is not None:
            _draw_agents(axes, joint.recordings.select([episode]))
    handles, labels = plots[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", fontsize=8, ncols=4)
    return figure


def _draw_agents(axes: Axes, episode: Recordings) -> None:
    """Each agent's track, start and detections in a colour of its own."""
    for begin, end, color in zip(episode.offset[:-1], episode.offset[1:], (_INK, _CAUGHT, _VIA), strict=True):
        place = episode.position_m[begin:end] / 1000.0
        axes.plot(*place.T, color=color, lw=1.4)
        axes.plot(*place[0], "o", color=color, ms=6)
        axes.plot(*place[episode.is_detected[begin:end]].T, ".", color=_SEEN, mec=color, mew=0.7, ms=7)


def save(figure: Figure, path: Path) -> None:
    """Write a figure as a PNG of 256 colours, which keeps it small."""
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=110)
    plt.close(figure)
    Image.open(buffer).convert("RGB").quantize(256, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(
        path, optimize=True
    )
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


def main() -> None:
    """Draw the worlds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--publish", type=Path, required=True, help="folder for the pictures")
    folder = parser.parse_args().publish
    folder.mkdir(parents=True, exist_ok=True)
    save(draw_narco(), folder / "world-narco.png")
    save(draw_prison(), folder / "world-prison.png")
    save(draw_rendezvous(), folder / "world-rendezvous.png")


if __name__ == "__main__":
    main()
