"""Do detections that are put into samples make jumps, where the network is perfect but knows the detections only roughly?

The network is replaced by the exact denoiser of a Gaussian process of tracks (integrated Ornstein-Uhlenbeck velocity) that has
seen the detections with an error of a few step lengths, as trained networks do. No training, seconds on one thread; the exact
posterior, in which the detections are exact, is the row to meet.

    python -m benchmarks.inpainting_closed_form --publish docs
"""

import argparse
from pathlib import Path

import torch
from torch import Tensor

from benchmarks import publishing
from benchmarks.publishing import Measurement
from cadence.diffusion.inpainting import grid_detections, known_cells, overwritten, overwritten_at_level, smoother_correction
from cadence.diffusion.sampler import sample_ddpm, sample_dpmpp_2m
from cadence.schedule import cosine_schedule

T, STEP, MEMORY, RATE = 64, 0.02, 8.0, 0.12
MODES = ("none", "overwrite", "noise_matched", "smoother")


def prior() -> Tensor:
    """Covariance [T, T] of a coordinate: a start anywhere, velocity of `STEP` a step remembered for `MEMORY` steps."""
    steps = torch.arange(T - 1, dtype=torch.float64)
    velocity = 0.5 * STEP**2 * torch.exp(-(steps[:, None] - steps).abs() / MEMORY)
    walk = torch.tril(torch.ones(T, T - 1, dtype=torch.float64), -1)
    return 0.09 + walk @ velocity @ walk.T


def conditioned(kernel: Tensor, is_seen: Tensor, values: Tensor, sigma: float) -> tuple[Tensor, Tensor]:
    """Mean [B, T, 2] and covariance [B, T, T] given `values` where `is_seen`, with an error of `sigma`."""
    noise = torch.diag_embed(torch.where(is_seen, sigma**2 + 1e-12, 1e9))
    gain = torch.linalg.solve(kernel + noise, kernel.expand(len(is_seen), -1, -1)).mT
    return gain @ values, kernel - gain @ kernel


def row(position: Tensor, truth: Tensor, is_seen: Tensor) -> publishing.Row:
    """Lengths of steps (mean, and that which 95 % do not exceed) and errors, in typical steps."""
    step = (position[:, :, 1:] - position[:, :, :-1]).norm(dim=-1) / STEP
    is_edge = (is_seen[:, 1:] != is_seen[:, :-1])[:, None].expand(step.shape)
    is_far = ~(is_seen[:, 1:] | is_seen[:, :-1])[:, None].expand(step.shape)
    found: publishing.Row = {}
    for name, mask in (("step_at_edges", is_edge), ("step_elsewhere", is_far)):
        found |= {f"{name}_mean": float(step[mask].mean()), f"{name}_95": float(step[mask].quantile(0.95))}
    error = (position - truth[:, None]).norm(dim=-1).mean(dim=1) / STEP
    of_mean = (position.mean(dim=1) - truth).norm(dim=-1) / STEP
    return found | {
        "error_where_seen": float(error[is_seen].mean()), "error_elsewhere": float(error[~is_seen].mean()),
        "error_of_mean_elsewhere": float(of_mean[~is_seen].mean()),
    }  # fmt: skip


def rows_of(floor_steps: int, num_windows: int, num: int, seed: int) -> list[publishing.Row]:
    """Rows for a network that knows detections to `floor_steps` step lengths."""
    generator = torch.Generator().manual_seed(seed)
    kernel = prior()
    factor = torch.linalg.cholesky(kernel + 1e-12 * torch.eye(T))
    truth = factor @ torch.randn(num_windows, T, 2, generator=generator, dtype=torch.float64)
    is_seen = torch.rand(num_windows, T, generator=generator) < RATE
    at = torch.arange(T, dtype=torch.float64).expand(num_windows, T)
    found = grid_detections(at, truth, torch.zeros(num_windows, T, 2, 2, dtype=torch.float64), is_seen, T)
    cells = known_cells(found)
    correction = smoother_correction(found, dtype=torch.float64)
    rough = truth + floor_steps * STEP * torch.randn(truth.shape, generator=generator, dtype=torch.float64)
    mean, covariance = conditioned(kernel, is_seen, rough, floor_steps * STEP)
    value, basis = torch.linalg.eigh(covariance)
    value = value.clamp_min(0)[:, None, :, None]

    def denoise(state: Tensor, angle: float) -> Tensor:
        c, s = torch.cos(torch.tensor(angle)).item(), torch.sin(torch.tensor(angle)).item()
        inner = basis.mT[:, None] @ (state - c * mean[:, None])
        return mean[:, None] + basis[:, None] @ (c * value / (c**2 * value + s**2) * inner)

    exact_mean, exact_covariance = conditioned(kernel, is_seen, truth, 0.0)
    spread, turn = torch.linalg.eigh(exact_covariance)
    shape = (num_windows, num, T, 2)
    drawn = turn[:, None] @ (spread.clamp_min(0).sqrt()[:, None, :, None] * torch.randn(shape, generator=generator).double())
    drawn = exact_mean[:, None] + drawn
    rows = [
        {"known_to_steps": floor_steps, "sampler": name, "inpainting": None, **row(position, truth, is_seen)}
        for name, position in (("truth", truth[:, None]), ("exact posterior", drawn))
    ]
    schedule = cosine_schedule()
    angles = torch.linspace(float(schedule.angle[-1]), 0.0, 11, dtype=torch.float64)
    for sampler in ("ddpm-100", "dpmpp-10"):
        for mode in MODES:
            start = torch.randn(shape, generator=generator, dtype=torch.float64)

            def on_state(state: Tensor, angle: float, mode: str = mode, start: Tensor = start) -> Tensor:
                if mode == "overwrite":
                    return overwritten(state, cells)
                return overwritten_at_level(state, cells, angle, start) if mode == "noise_matched" else state

            def corrected(state: Tensor, angle: float, mode: str = mode) -> Tensor:
                return correction(denoise(state, angle)) if mode == "smoother" else denoise(state, angle)

            if sampler == "ddpm-100":
                position = sample_ddpm(corrected, start, schedule, generator, on_state=on_state)
            else:
                position = sample_dpmpp_2m(corrected, start, angles, on_state=on_state)
            what = {"known_to_steps": floor_steps, "sampler": sampler, "inpainting": mode}
            rows.append({**what, **row(position, truth, is_seen)})
    return rows


def section(measured: Measurement) -> str:
    """Steps at the edges, where the network knows detections to a few steps."""
    known = max(row["known_to_steps"] for row in measured.rows())

    def step(sampler: str, mode: str | None) -> str:
        (row,) = measured.rows(known_to_steps=known, sampler=sampler, inpainting=mode)
        return f"{row['step_at_edges_mean']:.2f}"

    words = ", ".join(f"{step('ddpm-100', mode)} ({mode})" for mode in MODES[1:])
    return (
        f"A perfect denoiser that knows detections to {known} typical steps, mean step at the edges in these: {words}; "
        f"the exact posterior's is {step('exact posterior', None)}."
    )


def main() -> None:
    """Measure, print and publish."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--publish", type=Path, metavar="DOCS", help="write numbers and section below this folder")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--windows", type=int, default=48)
    parser.add_argument("--hypotheses", type=int, default=10)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows = [row for known in (3, 1) for row in rows_of(known, arguments.windows, arguments.hypotheses, arguments.seed)]
    facts = publishing.facts_of("inpainting_closed_form")
    facts |= {"num_windows": arguments.windows, "num_hypotheses": arguments.hypotheses}
    measured = Measurement("inpainting_closed_form", facts, {"inpainting_closed_form": rows})
    publishing.publish(measured, section, arguments.publish)


if __name__ == "__main__":
    main()
