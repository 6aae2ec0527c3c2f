"""What `benchmarks.real_logs` found, as the section of its page and as a picture."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks import publishing
from benchmarks.publishing import Measurement
from cadence.metrics import Interval

OWN = "cadence"
SHOWN = ("past", "between", "future")


@dataclass(frozen=True)
class Row:
    """One estimator on one log at one rate, over all seeds. `ratio` is to the best of the rivals by energy score."""

    log: str
    rate: float
    part: str
    estimator: str
    means: dict[str, Interval]
    num_cells: int
    ratio: Interval | None
    better: str | None


def _is_ahead(row: publishing.Row) -> bool:
    return float(row["ratio_high"] or "nan") < 1.0


def _is_behind(row: publishing.Row) -> bool:
    return float(row["ratio_low"] or "nan") > 1.0


def section(measured: Measurement) -> str:
    """Ratios between detections and beyond the last one, and coverage."""
    own = measured.rows(estimator=OWN)
    heads = ["log, detections", "between: CADENCE", "bank", "best rival", "future: CADENCE", "bank", "best rival", "in 90 %"]
    lines = []
    for log, percent in dict.fromkeys((row["log"], row["detections_percent"]) for row in own):
        found = {(r["part"], r["estimator"]): r for r in measured.rows(log=log, detections_percent=percent)}
        cells = []
        for part in ("between", "future"):
            cells.append(publishing.interval(found[part, OWN], "ratio", ".2f"))
            cells += [f"{found[part, 'bank']['ratio']:.2f}", str(found[part, OWN]["ratio_to"])]
        shares = [f"{100 * found[part, OWN]['coverage_90']:.0f}" for part in ("between", "future")]
        lines.append([f"{log}, {percent} %", *cells, f"{', '.join(shares)} %"])
    shown = [row for row in own if row["part"] != "past"]
    num_ahead, num_behind = (sum(map(of, shown)) for of in (_is_ahead, _is_behind))
    text = (
        f"Energy score over that of the best rival of the cell. Of {len(shown)} cells (log, share of detections, part) CADENCE "
        f"is ahead in {num_ahead} with its whole interval, behind in {num_behind}."
    )
    return f"{text}\n\n{publishing.table(heads, lines)}"


def draw_chart(rows: Sequence[Row], path: Path) -> None:
    """Ratios to the best rival: a panel a log and part, a group a rate, a mark an estimator."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    logs, names = list(dict.fromkeys(r.log for r in rows)), list(dict.fromkeys(r.estimator for r in rows))
    figure, axes = plt.subplots(len(logs), len(SHOWN), figsize=(12, 2.8 * len(logs)), squeeze=False, layout="constrained")
    for axis_row, log in zip(axes, logs, strict=True):
        for axis, part in zip(axis_row, SHOWN, strict=True):
            here = [row for row in rows if row.log == log and row.part == part and row.ratio is not None]
            rates = list(dict.fromkeys(row.rate for row in here))
            for index, name in enumerate(names):
                ratios = [(rates.index(row.rate), row.ratio) for row in here if row.estimator == name and row.ratio]
                x = [place + 0.8 * ((index + 0.5) / len(names) - 0.5) for place, _ in ratios]
                y = np.array([ratio.value for _, ratio in ratios])
                reach = np.array([[ratio.value - ratio.low, ratio.high - ratio.value] for _, ratio in ratios]).T.reshape(2, -1)
                axis.errorbar(x, y, np.maximum(reach, 0.0), fmt="o", color=f"C{index}", label=name, capsize=2)
            axis.axhline(1.0, color="0.6", linewidth=1)
            axis.set_yscale("log")
            axis.set_ylim(0.25, 4.0)
            ticks = [0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0]
            axis.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
            axis.minorticks_off()
            axis.set_xticks(range(len(rates)), [f"{100 * rate:.0f} %" for rate in rates])
            axis.set_title(f"{log}, {part}", fontsize=10)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(names), fontsize=9)
    figure.suptitle(
        "Energy score over that of the best rival of the cell (below 1 is better; beyond 4 is not shown)", fontsize=11
    )
    figure.savefig(path, dpi=110)
    plt.close(figure)
