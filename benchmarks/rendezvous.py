"""Several targets at once: what knowing whose a detection is, and drawing all agents together, are worth.

Held-out episodes of the world rendezvous: three agents who meet before their goal or do not, detected in 10 to 12 % of the
steps. Four networks of one size, trained alike: with known and unknown origin, with attention between agents and without.
Without attention and with known origin a network is the single-target model, agent by agent. Beside them the shipped network,
which was trained longer: with known origin, and with detections of unknown origin told apart first (several ways of weight).

    python benchmarks/rendezvous.py --publish docs
"""

import argparse
import dataclasses
import hashlib
import itertools
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

from cadence import metrics
from cadence.arrays import Float64s, Int64s
from cadence.association.associate import associate
from cadence.association.types import AssociationConfig
from cadence.diffusion.scene import SceneModel, SceneSampling
from cadence.recordings import ForecastWindows, choose_windows, cut_windows
from cadence.resampling import systematic
from cadence.types import Detections, HypothesisSet, WindowBatch
from cadence.worlds.joint import JointRecordings, meets
from cadence.worlds.rendezvous import RendezvousConfig, simulate_rendezvous, simulate_rendezvous_batch
from cadence.worlds.rendezvous_map import GOALS_M, SITES_M
from pipeline.checkpoints import checkpoint_hash, find_checkpoint
from pipeline.estimators.scene import load_scene
from pipeline.files import write_atomic
from pipeline.provenance import versions

HORIZONS = (0, 29, 59, 89, 119)
LABELS = ("0", "30", "60", "90", "120")
NUM_HYPOTHESES = 30
SAMPLING = SceneSampling(precision="bfloat16")
APART_M = 4000.0
SOON_M = 1500.0
"""Agents nearer to a site than this are not shown in the picture: that they meet is no question any more."""
NUM_WAYS = 15
"""Ways of telling detections apart for a window; each has two hypotheses."""
STEPS = (40, 160)
"""Windows begin so many minutes after their episode: most groups that meet are on their way then, and meet within two hours."""
KNOWN, KNOWN_ALONE = "known origin, attention", "known origin, no attention (single-target model)"
SHIPPED, TOLD_APART = "shipped: known origin, attention", "shipped: unknown origin, told apart first"
MEETING_M = 1500.0
"""Half of the least distance of two sites. Truth meets as often at 300 m; hypotheses may be a kilometre off."""
RADII_M = (500.0, 1000.0, MEETING_M, 2000.0, 3000.0)
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
        scores[row.name] = Scores.of(row, found[row.name], windows)
        print(f"{row.name}: {time.perf_counter() - begun:.0f} s", file=sys.stderr)
    if options.only is not None:
        return
    page = render(scores, windows, options)
    print(page)
    if options.publish is not None:
        (options.publish / "images").mkdir(parents=True, exist_ok=True)
        write_atomic(options.publish / "benchmarks" / "rendezvous.md", page)
        draw_two(found[SHIPPED], windows).savefig(options.publish / "images" / "rendezvous.png", dpi=110)


def parser() -> argparse.ArgumentParser:
    """The options."""
    found = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    found.add_argument("--windows", type=int, default=300)
    found.add_argument("--episodes", type=int, default=150)
    found.add_argument("--seed", type=int, default=7, help="of the held-out episodes; training has 2026, validation 1")
    found.add_argument("--work", type=Path, default=Path("out/benchmarks/rendezvous"), help="hypotheses are kept there")
    found.add_argument("--only", action="append", metavar="ROW", help="draw only these rows, for a later run; no page")
    found.add_argument("--publish", type=Path, metavar="DOCS", help="write the page and the picture below this folder")
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
    model = load_scene(weights, SAMPLING)
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


def told_apart(model: SceneModel, windows: ForecastWindows, episodes: JointRecordings) -> HypothesisSet:
    """Hypotheses for windows whose detections say nothing of their agents; each way of telling them apart has its share.

    An agent to which a way gives no detection stands where something was seen last.
    """
    slots, per_way = NUM_WAYS, NUM_HYPOTHESES // NUM_WAYS
    labelled = [labelled_detections(windows, row, episodes) for row in ways_of(windows, episodes)]
    parts = []
    for begin in range(0, len(labelled), 20):
        chunk = labelled[begin : begin + 20]
        pick = torch.arange(begin, begin + len(chunk)).repeat_interleave(slots)
        w = windows.windows
        seeds = w.seeds[pick] + torch.arange(slots).repeat(len(chunk))
        batch = WindowBatch(w.time_s, joined(chunk), seeds, 0)
        drawn = model.sample(batch.with_context(windows.context[pick]), per_way).position_m
        parts.append(drawn.reshape(len(chunk), NUM_HYPOTHESES, *drawn.shape[2:]))
    position = torch.cat(parts)
    last = torch.stack([_latest(windows.windows.detections[slice(b, b + 1)]) for b in range(len(windows))])
    return equally_likely(torch.where(position.isnan(), last[:, None, None, None], position))


@dataclasses.dataclass(frozen=True, eq=False)
class Ways:
    """One window's ways: label [M, N] of the detections at `step` [N], `position_m` [N, 2] in the mission frame."""

    window: int
    label: Int64s
    step: Int64s
    position_m: Float64s


def ways_of(windows: ForecastWindows, episodes: JointRecordings) -> list[Ways]:
    """For every window `NUM_WAYS` ways of equal weight to tell its detections apart."""
    found: dict[int, Ways] = {}
    recordings, agents = episodes.recordings, episodes.num_agents
    config = AssociationConfig(num_agents=agents, num_ways=NUM_WAYS)
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
        for window, ways in zip(
            mine, associate(time_s, place, covariance, origins * recordings.step_s, config, episode), strict=True
        ):
            slot = systematic(ways.weight, NUM_WAYS, 0.5)
            known = ways.num_detections
            found[window] = Ways(window, ways.label[slot], step[:known], place[:known])
    return [found[window] for window in range(len(windows))]


def labelled_detections(windows: ForecastWindows, ways: Ways, episodes: JointRecordings) -> Detections:
    """The window's detections under each way [M, A, N], relative to the window."""
    agents, num = episodes.num_agents, ways.label.shape[1]
    origin, step_s = int(windows.step[ways.window]), episodes.recordings.step_s
    time_s = torch.from_numpy((ways.step - origin) * step_s).expand(len(ways.label), agents, num)
    place = torch.from_numpy(ways.position_m) - windows.context.datum_m[ways.window]
    is_observed = torch.from_numpy(ways.label)[:, None] == torch.arange(agents)[:, None]
    order = (~is_observed).long().argsort(dim=-1, stable=True)  # left-packed, oldest first
    place = place.expand(len(ways.label), agents, num, 2).gather(2, order[..., None].expand(-1, -1, -1, 2))
    covariance = torch.eye(2, dtype=torch.float64).expand(*is_observed.shape, 2, 2)
    return Detections(time_s.gather(2, order), place, covariance, is_observed.gather(2, order))


def joined(parts: list[Detections]) -> Detections:
    """Several windows' detections as one batch."""
    num = max(part.time_s.shape[2] for part in parts)
    columns: dict[str, list[Tensor]] = {}
    for part in parts:
        for name, value in vars(part).items():
            padded = value.new_zeros(*value.shape[:2], num, *value.shape[3:])
            padded[:, :, : value.shape[2]] = value
            columns.setdefault(name, []).append(padded)
    return Detections(**{name: torch.cat(values) for name, values in columns.items()})


def _latest(detections: Detections) -> Tensor:
    """Where something was seen last in one window [2]."""
    time_s = torch.where(detections.is_observed, detections.time_s, -torch.inf).flatten()
    return detections.position_m.reshape(-1, 2)[time_s.argmax()]


@dataclasses.dataclass(frozen=True, eq=False)
class Scores:
    """What one estimator got, a value a window [B] or a window and horizon [B, H], in metres unless said otherwise.

    at_step, ade, least  error of single hypotheses at the step and on average up to it, and of the best joint hypothesis
    mean_error           of the mean of the hypotheses
    joint, joint_set     energy score of all agents' tracks as one vector; the same with the kindest order of agents
    is_inside            [B, H] share of agents inside the 90 % region
    meets                [B, R] share of hypotheses in which all agents meet at one site, for the radii `RADII_M`
    """

    at_step: Tensor
    ade: Tensor
    least: Tensor
    mean_error: Tensor
    joint: Tensor
    joint_set: Tensor
    is_inside: Tensor
    meets: Float64s

    @staticmethod
    def of(row: Row, drawn: HypothesisSet, windows: ForecastWindows) -> "Scores":
        """Where the origin is unknown, the agents of every hypothesis are put in the order that suits the truth best."""
        truth, weight = windows.truth_m.double(), drawn.weight.double()
        position = drawn.position_m.double()
        is_known = torch.ones(truth.shape[:-1], dtype=torch.bool)
        joint = metrics.trajectory_energy_score(position, weight, truth, is_known)
        joint_set = torch.stack([set_energy(p, t) for p, t in zip(position, truth, strict=True)])
        absolute = position + windows.context.datum_m[:, None, None, None]
        share = np.stack([meets(absolute.numpy(), SITES_M, radius_m).mean(axis=1) for radius_m in RADII_M], axis=1)
        if not row.has_names:
            position = torch.stack([arranged(p, t) for p, t in zip(position, truth, strict=True)])
        at = list(HORIZONS)
        error = metrics.expected_distance(position, weight, truth).mean(dim=1)  # [B, T], mean over agents
        upto = error.cumsum(dim=1) / torch.arange(1, truth.shape[2] + 1)
        least = metrics.min_ade_distance(position, weight, truth, is_known, is_joint=True).mean(dim=1)
        mean_error = metrics.mean_error(position, weight, truth).mean(dim=1)[:, at]
        inside = metrics.coverage(position[:, :, :, at], weight, truth[:, :, at], (0.9,))[0].mean(dim=1)
        return Scores(error[:, at], upto[:, at], least[:, at], mean_error, joint, joint_set, inside, share)


def arranged(position: Tensor, truth: Tensor) -> Tensor:
    """Hypotheses [K, A, T, 2], the agents of each in the order of least error."""
    orders = torch.tensor(list(itertools.permutations(range(position.shape[1]))))
    cost = (position[:, :, None] - truth[None, None]).norm(dim=-1).sum(dim=-1)  # [K, drawn, true]
    total = torch.stack([cost[:, order, torch.arange(len(order))].sum(dim=1) for order in orders], dim=1)
    best = orders[total.argmin(dim=1)]  # [K, A]
    return position.gather(1, best[:, :, None, None].expand_as(position))


def set_energy(position: Tensor, truth: Tensor) -> Tensor:
    """Energy score of hypotheses [K, A, T, 2] whose agents have no order: distances are those of the best matching."""
    k, a = position.shape[:2]
    flat = torch.cat([position, truth[None]]).flatten(2)  # [K + 1, A, T * 2]
    squared = torch.cdist(flat.flatten(0, 1), flat.flatten(0, 1)).square().reshape(k + 1, a, k + 1, a).permute(0, 2, 1, 3)
    orders = list(itertools.permutations(range(a)))
    least = torch.stack([squared[:, :, torch.arange(a), list(order)].sum(dim=-1) for order in orders]).amin(dim=0)
    distance = (least / (a * truth.shape[1])).sqrt()
    return distance[:k, k].mean() - 0.5 * distance[:k, :k].mean()


def render(scores: dict[str, Scores], windows: ForecastWindows, options: argparse.Namespace) -> str:
    """The page."""
    groups = windows.episode.numpy()
    rng = np.random.default_rng(0)

    def cell(values: Tensor | Float64s, scale: float = 1e-3, digits: int = 2) -> str:
        found = metrics.bootstrap_mean(np.asarray(values), groups, rng)
        error = (found.high - found.low) / 3.92
        return f"{found.value * scale:.{digits}f} ± {error * scale:.{digits}f}"

    def table(title: str, value: Callable[[Scores], Tensor], scale: float = 1e-3, names: tuple[str, ...] | None = None) -> str:
        head = f"### {title}\n\n| | " + " | ".join(f"{label} min" for label in LABELS) + " |\n|---|" + "---|" * len(LABELS)
        rows = [
            f"| {name} | " + " | ".join(cell(value(scores[name])[:, h], scale) for h in range(len(LABELS))) + " |"
            for name in (names or scores)
        ]
        return "\n".join([head, *rows])

    with_names = tuple(row.name for row in ROWS if row.has_names)
    truth_m = (windows.truth_m + windows.context.datum_m[:, None, None]).numpy()
    true_meets = np.stack([meets(truth_m, SITES_M, radius_m) for radius_m in RADII_M], axis=1).astype(float)
    headline = RADII_M.index(MEETING_M)
    truth = true_meets[:, headline]
    joint = [
        "| | joint energy score, km | without order of agents, km | share of meetings | Brier score |",
        "|---|---|---|---|---|",
    ]
    for name, s in scores.items():
        labelled = cell(s.joint) if name in with_names else "–"
        share = s.meets[:, headline]
        brier = (share - truth) ** 2
        joint.append(f"| {name} | {labelled} | {cell(s.joint_set)} | {cell(share, 1)} | {cell(brier, 1, 3)} |")
    joint.append(f"| truth | | | {cell(truth, 1)} | {cell((truth.mean() - truth) ** 2, 1, 3)} (always the mean share) |")
    near = ["| | " + " | ".join(f"{radius_m:.0f} m" for radius_m in RADII_M) + " |", "|---|" + "---|" * len(RADII_M)]
    shares = {name: scores[name].meets for name in (SHIPPED, TOLD_APART)} | {"truth": true_meets}
    near += [f"| {name} | " + " | ".join(cell(column, 1) for column in share.T) + " |" for name, share in shares.items()]
    ratio = metrics.bootstrap_ratio(scores[KNOWN].joint, scores[KNOWN_ALONE].joint, groups, rng)
    apart = metrics.bootstrap_ratio(scores[TOLD_APART].joint_set, scores[SHIPPED].joint_set, groups, rng)
    parts = [
        "# Several targets at once",
        f"Made by `python benchmarks/rendezvous.py --windows {options.windows} --episodes {options.episodes} --seed "
        f"{options.seed} --publish docs` with {versions()['cadence']}; one training seed. {len(windows)} windows of "
        f"{len(np.unique(groups))} held-out episodes of the world rendezvous, three agents, 30 joint hypotheses, 120 steps of "
        "a minute. Errors in kilometres, mean over agents, ± standard error by a bootstrap over episodes. Sampler: "
        f"DPM-Solver++ with six steps (bfloat16), fixed before. Windows begin {STEPS[0]} to {STEPS[1]} minutes after their "
        "episode. The first four networks have one size and were trained alike (4 500 steps of 64 windows, "
        "`benchmarks/configs/rendezvous_{base,alone,unknown,unknown_alone}.toml`); the shipped one was trained "
        "for 25 000 steps more (`cadence/checkpoints/rendezvous.toml`). Where the origin is unknown, "
        "the agents of each hypothesis are put in the order that suits the truth best, which favours these rows.",
        table("ADE: mean error of single hypotheses up to the horizon", lambda s: s.ade),
        table("minADE: error at the step of the best joint hypothesis", lambda s: s.least),
        table("Error at the step", lambda s: s.at_step),
        table("Error of the mean at the step", lambda s: s.mean_error),
        table("Share inside the 90 % region (aim .90)", lambda s: s.is_inside, 1.0, with_names),
        "## Together\n\n" + "\n".join(joint),
        f"Joint energy score, attention over none, known origin: {ratio.value:.3f} [{ratio.low:.3f}, {ratio.high:.3f}]. "
        f"The shipped network, unknown over known origin, without order of agents: {apart.value:.3f} [{apart.low:.3f}, "
        f"{apart.high:.3f}]. A meeting: all agents within {MEETING_M:.0f} m of one site at one step, by the same rule "
        "for truth and hypotheses, within the window's two hours.",
        "### Is the share of meetings right where it is stated?\n\n"
        + reliability(scores[SHIPPED].meets[:, headline], truth, groups, rng),
        "### Share of meetings, by how near to a site counts\n\n" + "\n".join(near),
        "![Two hypotheses of one window, one with a meeting and one without](../images/rendezvous.png)\n\nTwo joint hypotheses "
        "drawn from the same detections, one that meets and one that goes straight on; thin: all other hypotheses.",
    ]
    return "\n\n".join(parts) + "\n"


def reliability(share: Float64s, truth: Float64s, groups: Int64s, rng: np.random.Generator) -> str:
    """How often agents met, by how often the hypotheses did."""
    rows = ["| share of hypotheses that meet | windows | mean share | truth |", "|---|---|---|---|"]
    for low, high in ((0.0, 0.1), (0.1, 0.4), (0.4, 0.7), (0.7, 0.9), (0.9, 1.01)):
        pick = (share >= low) & (share < high)
        if pick.any():
            found = metrics.bootstrap_mean(truth[pick], groups[pick], rng)
            rows.append(
                f"| {low:.1f} to {min(high, 1.0):.1f} | {pick.sum()} | {share[pick].mean():.2f} | "
                f"{found.value:.2f} [{found.low:.2f}, {found.high:.2f}] |"
            )
    return "\n".join(rows)


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
    figure, axes = plt.subplots(1, 2, figsize=(13, 6.5), layout="constrained", sharex=True, sharey=True)
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
