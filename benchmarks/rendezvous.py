"""Several targets at once: what knowing whose a detection is, and drawing all agents together, are worth.

Held-out episodes of the world rendezvous: three agents who meet before their goal or do not, detected in 10 to 12 % of the
steps. Four networks of one size, trained alike: with known and unknown origin, with attention between agents and without.
Without attention and with known origin a network is the single-target model, agent by agent. Beside them the shipped network,
which was trained longer: with known origin, and with detections of unknown origin told apart first (association hypotheses).

    python -m benchmarks.rendezvous --publish docs
"""

import argparse
import dataclasses
import hashlib
import sys
import time
from collections.abc import Callable
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.patches import Circle
from torch import Tensor

from benchmarks import publishing
from benchmarks.publishing import Measurement
from benchmarks.rendezvous_scores import MEETING_M, RADII_M, Scores
from cadence import metrics
from cadence.arrays import Float64s, Int64s
from cadence.association.associate import associate
from cadence.association.types import AssociationConfig
from cadence.diffusion.place import PlaceModel
from cadence.diffusion.settings import PlaceSampling
from cadence.recordings import ForecastWindows, choose_windows, cut_windows
from cadence.resampling import systematic
from cadence.types import Detections, HypothesisSet, WindowBatch
from cadence.worlds.joint import JointRecordings, meets
from cadence.worlds.rendezvous import RendezvousConfig, simulate_rendezvous, simulate_rendezvous_batch
from cadence.worlds.rendezvous_map import GOALS_M, SITES_M
from pipeline.checkpoints import checkpoint_hash, find_checkpoint
from pipeline.estimators.place import load_place_model
from pipeline.provenance import versions

MINUTES = (0, 30, 60, 90, 120)
NUM_HYPOTHESES = 30
SAMPLING = PlaceSampling(precision="bfloat16")
APART_M = 4000.0
SOON_M = 1500.0
"""Agents nearer to a site than this are not shown in the picture: that they meet is no question any more."""
NUM_ASSOCIATIONS = 15
"""Association hypotheses of a window; each has two hypotheses."""
STEPS = (40, 160)
"""Windows begin so many minutes after their episode: most groups that meet are on their way then, and meet within two hours."""
KNOWN, KNOWN_ALONE = "known origin, attention", "known origin, no attention (single-target model)"
SHIPPED, TOLD_APART = "shipped: known origin, attention", "shipped: unknown origin, told apart first"
ATTENTION = "known origin, attention over no attention"
APART = "shipped, unknown over known origin, without order of agents"
NO_JOINT: publishing.Row = {"joint_energy_km": None, "joint_energy_km_error": None}
_COLOURS = ("#c8553d", "#2a6f97", "#588157")
_FOLDER = "benchmarks/checkpoints/rendezvous_"


@dataclasses.dataclass(frozen=True)
class Row:
    """A row of the tables: its name, the checkpoint, whether it is told whose a detection is, or tells them apart itself."""

    name: str
    checkpoint: str
    has_names: bool = True
    is_told_apart: bool = False


ROWS = (
    Row(KNOWN, f"{_FOLDER}base.safetensors"),
    Row(KNOWN_ALONE, f"{_FOLDER}alone.safetensors"),
    Row("unknown origin, shared embedding, attention", f"{_FOLDER}unknown.safetensors", has_names=False),
    Row("unknown origin, shared embedding, no attention", f"{_FOLDER}unknown_alone.safetensors", has_names=False),
    Row(SHIPPED, "rendezvous"),
    Row(TOLD_APART, "rendezvous", has_names=False, is_told_apart=True),
)


HAS_NAMES = {row.name: row.has_names for row in ROWS}


def main() -> None:
    """Score, print, publish."""
    options = parser().parse_args()
    torch.set_num_threads(1)
    episodes = simulate_rendezvous_batch(RendezvousConfig(), options.seed, np.arange(options.episodes))
    windows = held_out(episodes, options.windows, options.seed)
    print(f"{len(windows)} windows of {len(windows.episode.unique())} episodes", file=sys.stderr)
    scores, found = {}, {}
    for row in ROWS:
        if options.only is not None and row.name not in options.only:
            continue
        begun = time.perf_counter()
        found[row.name] = drawn(row, windows, episodes, options)
        scores[row.name] = Scores.of(found[row.name], windows, row.has_names)
        print(f"{row.name}: {time.perf_counter() - begun:.0f} s", file=sys.stderr)
    if options.only is not None:
        return
    facts = publishing.facts_of("rendezvous") | {
        "num_windows": len(windows), "num_episodes": len(windows.episode.unique()), "num_hypotheses": NUM_HYPOTHESES,
    }  # fmt: skip
    publishing.publish(Measurement("rendezvous", facts, tables(scores, windows)), section, options.publish)
    if options.publish is not None:
        draw_two(found[SHIPPED], windows).savefig(options.publish / "images" / "rendezvous.png", dpi=110)


def parser() -> argparse.ArgumentParser:
    """The options."""
    found = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    found.add_argument("--windows", type=int, default=300)
    found.add_argument("--episodes", type=int, default=150)
    found.add_argument("--seed", type=int, default=7, help="of the held-out episodes; training has 2026, validation 1")
    found.add_argument("--work", type=Path, default=Path("out/benchmarks/rendezvous"), help="hypotheses are kept there")
    found.add_argument(
        "--only", action="append", metavar="ROW", help="draw only these rows, for a later run; nothing is published"
    )
    found.add_argument("--publish", type=Path, metavar="DOCS", help="write numbers, section and picture below this folder")
    return found


def held_out(episodes: JointRecordings, num: int, seed: int) -> ForecastWindows:
    """Windows at random steps of `STEPS`, at which every agent was detected before; nobody is told where agents started."""
    episode, step = choose_windows(episodes.recordings, 6 * num, np.random.default_rng(seed), known_start=False)
    is_between = (step >= STEPS[0]) & (step < STEPS[1])
    episode, step = episode[is_between], step[is_between]
    windows = cut_windows(episodes.recordings, episode, step, known_start=False, seed=seed)
    is_useful = windows.windows.is_active.all(dim=1).nonzero()[:, 0]
    chosen = torch.randperm(len(is_useful), generator=torch.Generator().manual_seed(seed))[:num]
    return windows[is_useful[chosen.sort().values]]


def drawn(row: Row, windows: ForecastWindows, episodes: JointRecordings, options: argparse.Namespace) -> HypothesisSet:
    """The row's hypotheses; kept in the work folder, so that a killed run goes on."""
    weights = find_checkpoint(row.checkpoint)
    asked = (options.windows, options.episodes, options.seed)
    key = [row.name, checkpoint_hash(weights), asked, SAMPLING, versions()["cadence"]]
    path = options.work / f"{hashlib.sha256(repr(key).encode()).hexdigest()[:16]}.npy"
    if path.is_file():
        return equally_likely(torch.from_numpy(np.load(path)).double())
    model = load_place_model(weights, SAMPLING)
    if row.is_told_apart:
        found = told_apart(model, windows, episodes)
    else:
        found = model.sample(windows.windows, NUM_HYPOTHESES)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".part.npy")
    np.save(partial, found.position_m.float().numpy())
    partial.replace(path)
    return found


def equally_likely(position: Tensor) -> HypothesisSet:
    """Hypotheses [B, K, A, T, 2] of one weight, all agents there."""
    weight = torch.full(position.shape[:2], 1.0 / position.shape[1])
    return HypothesisSet(position, weight, (("ok",) * position.shape[2],) * len(position))


def told_apart(model: PlaceModel, windows: ForecastWindows, episodes: JointRecordings) -> HypothesisSet:
    """Hypotheses for windows whose detections say nothing of their agents; each association hypothesis has its share.

    An agent to which one gives no detection stands where something was seen last.
    """
    slots, per_association = NUM_ASSOCIATIONS, NUM_HYPOTHESES // NUM_ASSOCIATIONS
    labelled = [labelled_detections(windows, row, episodes) for row in associations_of(windows, episodes)]
    parts = []
    for begin in range(0, len(labelled), 20):
        chunk = labelled[begin : begin + 20]
        pick = torch.arange(begin, begin + len(chunk)).repeat_interleave(slots)
        w = windows.windows
        seeds = w.seeds[pick] + torch.arange(slots).repeat(len(chunk))
        batch = WindowBatch(w.time_s, joined(chunk), seeds, 0)
        drawn = model.sample(batch.with_context(windows.context[pick]), per_association).position_m
        parts.append(drawn.reshape(len(chunk), NUM_HYPOTHESES, *drawn.shape[2:]))
    position = torch.cat(parts)
    last = torch.stack([_latest(windows.windows.detections[slice(b, b + 1)]) for b in range(len(windows))])
    return equally_likely(torch.where(position.isnan(), last[:, None, None, None], position))


@dataclasses.dataclass(frozen=True, eq=False)
class WindowAssociations:
    """One window's association hypotheses: label [M, N] of the detections at `step` [N], position_m [N, 2] (mission frame)."""

    window: int
    label: Int64s
    step: Int64s
    position_m: Float64s


def associations_of(windows: ForecastWindows, episodes: JointRecordings) -> list[WindowAssociations]:
    """For every window `NUM_ASSOCIATIONS` association hypotheses of equal weight."""
    found: dict[int, WindowAssociations] = {}
    recordings, agents = episodes.recordings, episodes.num_agents
    config = AssociationConfig(num_agents=agents, num_associations=NUM_ASSOCIATIONS)
    for episode in windows.episode.unique().tolist():
        first, end = recordings.offset[[episode * agents, (episode + 1) * agents]]
        seen = recordings.is_detected[first:end].reshape(agents, -1)
        agent, step = np.nonzero(seen)
        order = np.argsort(step, kind="stable")
        agent, step = agent[order], step[order]
        place = episodes.track_m(episode)[agent, step].astype(np.float64)
        mine = (windows.episode == episode).nonzero()[:, 0].tolist()
        origins = windows.step[mine].numpy()
        covariance = np.broadcast_to(np.eye(2), (len(step), 2, 2))
        time_s = step * recordings.step_s
        for window, associations in zip(
            mine, associate(time_s, place, covariance, origins * recordings.step_s, config, episode), strict=True
        ):
            slot = systematic(associations.weight, NUM_ASSOCIATIONS, 0.5)
            known = associations.num_detections
            found[window] = WindowAssociations(window, associations.label[slot], step[:known], place[:known])
    return [found[window] for window in range(len(windows))]


def labelled_detections(windows: ForecastWindows, associations: WindowAssociations, episodes: JointRecordings) -> Detections:
    """The window's detections under each association [M, A, N], relative to the window."""
    agents, num = episodes.num_agents, associations.label.shape[1]
    origin, step_s = int(windows.step[associations.window]), episodes.recordings.step_s
    time_s = torch.from_numpy((associations.step - origin) * step_s).expand(len(associations.label), agents, num)
    place = torch.from_numpy(associations.position_m) - windows.context.datum_m[associations.window]
    is_observed = torch.from_numpy(associations.label)[:, None] == torch.arange(agents)[:, None]
    order = (~is_observed).long().argsort(dim=-1, stable=True)  # left-packed, oldest first
    place = place.expand(len(associations.label), agents, num, 2).gather(2, order[..., None].expand(-1, -1, -1, 2))
    covariance = torch.eye(2, dtype=torch.float64).expand(*is_observed.shape, 2, 2)
    return Detections(time_s.gather(2, order), place, covariance, is_observed.gather(2, order))


def joined(parts: list[Detections]) -> Detections:
    """Several windows' detections as one batch."""
    num = max(part.time_s.shape[2] for part in parts)
    columns: dict[str, list[Tensor]] = {}
    for part in parts:
        for name, value in vars(part).items():
            if value is None:  # heights, which no rendezvous has
                continue
            padded = value.new_zeros(*value.shape[:2], num, *value.shape[3:])
            padded[:, :, : value.shape[2]] = value
            columns.setdefault(name, []).append(padded)
    return Detections(**{name: torch.cat(values) for name, values in columns.items()})


def _latest(detections: Detections) -> Tensor:
    """Where something was seen last in one window [2]."""
    time_s = torch.where(detections.is_observed, detections.time_s, -torch.inf).flatten()
    return detections.position_m.reshape(-1, 2)[time_s.argmax()]


ERRORS: dict[str, tuple[Callable[[Scores], Tensor], float, bool]] = {
    "ade_km": (lambda scores: scores.ade, 1e-3, False), "min_ade_km": (lambda scores: scores.least, 1e-3, False),
    "error_at_step_km": (lambda scores: scores.at_step, 1e-3, False),
    "mean_error_km": (lambda scores: scores.mean_error, 1e-3, False),
    "coverage_90": (lambda scores: scores.is_inside, 1.0, True),
}  # fmt: skip
"""What is published by horizon: values, their factor, and whether they need to know which agent is which."""


def tables(scores: dict[str, Scores], windows: ForecastWindows) -> dict[str, list[publishing.Row]]:
    """All numbers, means over windows with standard errors by a bootstrap over episodes."""
    groups, rng = windows.episode.numpy(), np.random.default_rng(0)

    def mean(column: str, values: Tensor | Float64s, scale: float = 1.0) -> publishing.Row:
        found = metrics.bootstrap_mean(np.asarray(values), groups, rng)
        return {column: scale * found.value, f"{column}_error": scale * (found.high - found.low) / 3.92}

    errors = [
        {"measure": measure, "estimator": name, "horizon_min": minutes, **mean("value", value(of)[:, index], scale)}
        for measure, (value, scale, needs_names) in ERRORS.items()
        for name, of in scores.items()
        if not needs_names or HAS_NAMES[name]
        for index, minutes in enumerate(MINUTES)
    ]
    truth_m = (windows.truth_m + windows.context.datum_m[:, None, None]).numpy()
    true_meets = np.stack([meets(truth_m, SITES_M, radius_m) for radius_m in RADII_M], axis=1).astype(float)
    headline = RADII_M.index(MEETING_M)
    truth = true_meets[:, headline]
    joint = []
    for name, of in scores.items():
        share = of.meets[:, headline]
        named = mean("joint_energy_km", of.joint, 1e-3) if HAS_NAMES[name] else NO_JOINT
        sets = mean("unordered_joint_energy_km", of.joint_set, 1e-3)
        brier = mean("brier_score", (share - truth) ** 2)
        joint.append({"estimator": name, **named, **sets, **mean("meetings_share", share), **brier})
    # of truth: the score of whoever always says the mean share
    guess = mean("brier_score", (truth.mean() - truth) ** 2)
    joint.append({**dict.fromkeys(joint[0]), "estimator": "truth", **mean("meetings_share", truth), **guess})
    shares = {name: scores[name].meets for name in (SHIPPED, TOLD_APART)} | {"truth": true_meets}
    radii = [
        {"estimator": name, "radius_m": radius_m, **mean("meetings_share", column)}
        for name, share in shares.items()
        for radius_m, column in zip(RADII_M, share.T, strict=True)
    ]
    ratio = metrics.bootstrap_ratio(scores[KNOWN].joint, scores[KNOWN_ALONE].joint, groups, rng)
    apart = metrics.bootstrap_ratio(scores[TOLD_APART].joint_set, scores[SHIPPED].joint_set, groups, rng)
    ratios = [
        {"what": what, **publishing.columns("energy_ratio", found)} for what, found in ((ATTENTION, ratio), (APART, apart))
    ]
    return {
        "rendezvous_errors": errors, "rendezvous_joint": joint, "rendezvous_ratios": ratios,
        "rendezvous_reliability": reliability(scores[SHIPPED].meets[:, headline], truth, groups, rng),
        "rendezvous_radii": radii,
    }  # fmt: skip


def reliability(share: Float64s, truth: Float64s, groups: Int64s, rng: np.random.Generator) -> list[publishing.Row]:
    """How often agents met, by how often the hypotheses did."""
    rows = []
    for low, high in ((0.0, 0.1), (0.1, 0.4), (0.4, 0.7), (0.7, 0.9), (0.9, 1.01)):
        pick = (share >= low) & (share < high)
        if pick.any():
            found = metrics.bootstrap_mean(truth[pick], groups[pick], rng)
            rows.append({
                "share_of_hypotheses": f"{low:.1f} to {min(high, 1.0):.1f}", "num_windows": int(pick.sum()),
                "mean_share": share[pick].mean(), **publishing.columns("truth_share", found),
            })  # fmt: skip
    return rows


def section(measured: Measurement) -> str:
    """Error, energy score of all tracks together and share of meetings of every network."""

    def cell(row: publishing.Row, column: str) -> str:
        return "–" if row[column] is None else f"{row[column]:.2f} ± {row[f'{column}_error']:.2f}"

    lines = []
    for row in measured.rows("joint"):
        found = measured.rows("errors", measure="ade_km", estimator=row["estimator"], horizon_min=60)
        error = cell(found[0], "value") if found else "–"
        lines.append([row["estimator"], error, cell(row, "unordered_joint_energy_km"), cell(row, "meetings_share")])
    heads = ["", "ADE to 60 min, km", "joint energy score, km", "share of meetings"]
    attention, apart = (
        publishing.interval(measured.rows("ratios", what=what)[0], "energy_ratio", ".2f") for what in (ATTENTION, APART)
    )
    wide = max(RADII_M)
    ours, truth = (
        f"{100 * measured.rows('radii', estimator=name, radius_m=wide)[0]['meetings_share']:.0f} %"
        for name in (SHIPPED, "truth")
    )
    facts = measured.facts
    text = (
        f"{facts['num_windows']} windows of {facts['num_episodes']} episodes; ± standard error. Ratio of joint energy scores: "
        f"attention over none {attention}; told apart over named {apart}. Within {wide / 1000:g} km of a site {ours} of the "
        f"hypotheses meet, and {truth} of the groups did."
    )
    return f"{publishing.table(heads, lines)}\n\n{text}"


def draw_two(drawn: HypothesisSet, windows: ForecastWindows) -> plt.Figure:
    """Of windows in which nobody is at a site yet, the one most divided about meeting, and one hypothesis of either kind.

    One that goes straight on is one whose agents never come near each other.
    """
    absolute = (drawn.position_m.double() + windows.context.datum_m[:, None, None, None]).numpy()
    has_met = meets(absolute, SITES_M, MEETING_M)
    is_near = np.linalg.norm(absolute[:, :, :, 0, None] - SITES_M, axis=-1).min(axis=-1).mean(axis=1) < SOON_M  # [B, A]
    centre = absolute.mean(axis=2, keepdims=True)
    nearest_m = np.linalg.norm(absolute - centre, axis=-1).max(axis=2).min(axis=-1)  # [B, K] of the agent farthest from all
    is_apart = nearest_m > APART_M
    window = int((np.minimum(has_met.mean(axis=1), is_apart.mean(axis=1)) - is_near.any(axis=1)).argmax())
    figure, axes = plt.subplots(1, 2, figsize=(13, 7.0), layout="constrained", sharex=True, sharey=True)
    for axis, kind, title in zip(axes, (True, False), ("one that meets", "one that goes straight on"), strict=True):
        of_kind = (has_met if kind else is_apart)[window]
        chosen = int(np.where(of_kind, -nearest_m[window] if kind else nearest_m[window], -np.inf).argmax())
        _draw_place(axis)
        for agent, colour in enumerate(_COLOURS):
            for other in absolute[window, :, agent]:
                axis.plot(*other.T / 1e3, color=colour, alpha=0.12, linewidth=0.7)
            axis.plot(*absolute[window, chosen, agent].T / 1e3, color=colour, linewidth=2.2)
            d = windows.windows.detections
            seen = d.position_m[window, agent][d.is_observed[window, agent]] + windows.context.datum_m[window]
            axis.plot(*seen.numpy().T / 1e3, "o", color=colour, markersize=4, markeredgecolor="white", markeredgewidth=0.5)
        axis.set_title(f"{title} ({of_kind.mean():.0%} of the hypotheses)")
    return figure


def _draw_place(axis: Axes) -> None:
    terrain = simulate_rendezvous(RendezvousConfig(), 0, 0).terrain
    for x, y, radius in terrain.circles_m / 1e3:
        axis.add_patch(Circle((x, y), radius, color="#8d8478", alpha=0.6, linewidth=0))
    for polygon in terrain.polygons_m:
        axis.fill(*polygon.T / 1e3, color="#8d8478", alpha=0.6, linewidth=0)
    axis.plot(*SITES_M.T / 1e3, "s", color="#444444", markersize=7, markerfacecolor="none", label="meeting sites")
    axis.plot(*GOALS_M.T / 1e3, "*", color="#444444", markersize=10, markerfacecolor="none", label="goals")
    axis.set(aspect="equal", xlabel="east, km", ylabel="north, km", xlim=(-15, 15), ylim=(-15, 15))
    axis.legend(loc="upper left", fontsize=8)


if __name__ == "__main__":
    main()
