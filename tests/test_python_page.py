"""docs/python.md: every example is run, in order, as a reader would type them."""

import re
from pathlib import Path

import pytest

from cadence.worlds.patrol import PatrolConfig
from pipeline.progress import Progress
from pipeline.simulate.stage import SimulateConfig, simulate

PAGE = Path(__file__).resolve().parents[1] / "docs" / "python.md"
EXAMPLES = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


def test_examples_of_the_page_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    logs = tmp_path / "logs"
    simulate(logs, SimulateConfig(seed=13, patrol=PatrolConfig(duration_s=1200.0)), Progress(quiet=True))
    (log,) = logs.glob("*.mcap")
    log.rename(logs / "patrol.mcap")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for number, example in enumerate(EXAMPLES):
        exec(compile(example, f"docs/python.md, example {number + 1}", "exec"), names)
    printed = capsys.readouterr().out
    assert len(EXAMPLES) >= 7 and printed.startswith("done \n")
    assert "torch.Size([3, 30, 1, 120, 2])" in printed and "(('ok',),)" in printed
    assert (tmp_path / "hypotheses.png").stat().st_size > 5000
    assert float(printed.rsplit("tensor(", 1)[1].rstrip(")\n")) == pytest.approx(1.0, abs=0.1)
