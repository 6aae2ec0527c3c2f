"""Pictures of the paper's two worlds: the map, a hundred episodes, and what is known of the places.

python benchmarks/world_pictures.py --publish docs/images
"""

import argparse
import io
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from cadence.worlds import narco, ocean
from cadence.worlds.recordings import Recordings

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
    """Draw both worlds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--publish", type=Path, required=True, help="folder for the pictures")
    folder = parser.parse_args().publish
    folder.mkdir(parents=True, exist_ok=True)
    save(draw_narco(), folder / "world-narco.png")


if __name__ == "__main__":
    main()
