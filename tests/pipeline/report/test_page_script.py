"""The page's script in a browser: what a person does on the page, and what the map shows then."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from fixtures import mission as fixture
from fixtures.asked import asked_mission
from fixtures.browser import Browser, NoBrowser, Page, chromium
from fixtures.mission import GEOREFERENCED, build_mission, make_uncertain, rename_agents

from pipeline.progress import Progress
from pipeline.report.config import ReportConfig
from pipeline.report.stage import report
from pipeline.tables import read_table, write_table

Open = Callable[..., Page]
# Number of pixels of the map that are near a colour of the page's palette.
COUNT = """(name => {
  const wanted = getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim().slice(1);
  const [r, g, b] = [0, 2, 4].map(i => parseInt(wanted.slice(i, i + 2), 16));
  const map = document.getElementById("map");
  const { data } = map.getContext("2d").getImageData(0, 0, map.width, map.height);
  let count = 0;
  for (let i = 0; i < data.length; i += 4) if (Math.hypot(data[i] - r, data[i + 1] - g, data[i + 2] - b) < 12) count++;
  return count;
})"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    try:
        with chromium(tmp_path_factory.mktemp("profile")) as running:
            yield running
    except NoBrowser as reason:
        pytest.skip(str(reason))


@pytest.fixture(scope="module")
def report_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = build_mission(tmp_path_factory.mktemp("mission"), frame=GEOREFERENCED)
    report(directory, ReportConfig(), Progress(quiet=True))
    return directory / "report.html"


@pytest.fixture
def open_page(browser: Browser, report_page: Path) -> Iterator[Open]:
    """Opens the report; at the end no page may have complained."""
    pages: list[Page] = []

    def opened(
        path: Path = report_page, width: int = 1280, height: int = 900, is_dark: bool = False, is_phone: bool = False
    ) -> Page:
        pages.append(Page(browser, path, width, height, is_dark, is_phone))
        return pages[-1]

    yield opened
    for page in pages:
        assert not page.errors
        page.close()


def picture(page: Page) -> str:
    return page.ask("document.getElementById('map').toDataURL()")


def text(page: Page, selector: str) -> str:
    return page.ask(f"document.querySelector({selector!r}).textContent")


def count(page: Page, colour: str) -> int:
    return page.ask(f"{COUNT}({colour!r})")


def slide(page: Page, window: int) -> None:
    page.ask(f"(s => {{ s.value = {window}; s.dispatchEvent(new Event('input')); }})(document.getElementById('window'))")


def test_the_time_slider_changes_what_is_drawn(open_page: Open) -> None:
    page = open_page()
    seen = {}
    for window in (0, 3, 5):
        slide(page, window)
        seen[window] = picture(page)
        seconds = 40 + 20 * window
        assert (
            text(page, "#moment") == f"2023-11-14 22:{14 + (seconds - 40) // 60}:{(seconds - 40) % 60:02} UTC · window {window}"
        )
        assert page.ask("document.getElementById('window').getAttribute('aria-valuetext')") == text(page, "#moment")
    assert len(set(seen.values())) == 3
    assert "no detections" in text(page, "#agents li:nth-child(2) span")  # T1 in the last window
    slide(page, 0)
    assert picture(page) == seen[0]


LAYERS = ("past", "future", "mean", "envelopes", "detections", "everywhere", "names", "truth", "obstacles", "sensors")


def test_a_layer_is_drawn_while_its_box_is_ticked(open_page: Open) -> None:
    page = open_page()
    assert page.ask("[...document.querySelectorAll('[data-layer]')].map(box => box.dataset.layer)") == list(LAYERS)
    whole = picture(page)
    for layer in LAYERS:
        page.click(f"[data-layer={layer}]")
        assert picture(page) != whole, layer
        if layer in ("past", "future", "truth"):  # nothing else has their colours
            assert count(page, layer) == 0
        page.click(f"[data-layer={layer}]")
        assert picture(page) == whole and (layer not in ("past", "future", "truth") or count(page, layer) > 20)


def test_agents_are_hidden_and_shown(open_page: Open) -> None:
    page = open_page()
    both = picture(page), count(page, "future")
    page.click("#agents li:nth-child(1) input")
    assert 0 < count(page, "future") < both[1]
    page.click("#none")
    assert count(page, "future") == count(page, "past") == 0
    page.click("#all")
    assert picture(page) == both[0] and page.ask("[...document.querySelectorAll('#agents input')].every(box => box.checked)")
    page.click("#none")
    page.click("#agents li:nth-child(2) button")  # a name: zoom to it, and show it
    assert page.ask("[...document.querySelectorAll('#agents input')].map(box => box.checked)") == [False, True]
    assert count(page, "future") > 0


def test_the_map_is_moved_and_zoomed(open_page: Open) -> None:
    page = open_page()
    page.ask("document.getElementById('map').scrollIntoView({ block: 'center' })")
    x, y = page.middle("#map")
    page.mouse("mouseMoved", x, y)
    east_m, north_m = place(page)
    assert "° N, " in text(page, "#readout")
    whole = picture(page)
    page.mouse("mousePressed", x, y, button="left")
    page.mouse("mouseMoved", x + 80, y + 40, button="left", buttons=1)
    page.mouse("mouseReleased", x + 80, y + 40, button="left")
    assert place(page) == pytest.approx((east_m, north_m), abs=0.11)  # what was held stays under the pointer
    page.mouse("mouseMoved", x, y)
    moved_m = place(page)
    assert moved_m[0] < east_m and moved_m[1] > north_m
    page.mouse("mouseWheel", x, y, deltaX=0, deltaY=-300)
    page.mouse("mouseMoved", x, y)
    assert place(page) == pytest.approx(moved_m, abs=0.11)  # the wheel keeps the place under the pointer
    slide(page, 5)
    page.mouse("mouseMoved", x + 1, y)
    page.mouse("mouseMoved", x, y)
    assert place(page) == pytest.approx(moved_m, abs=0.11)  # what somebody looks at stays where it is
    slide(page, 2)
    for button in ("#zoom-in", "#zoom-out", "#fit-window", "#fit-all"):
        before = picture(page)
        page.click(button)
        assert picture(page) != before
    assert picture(page) == whole


def place(page: Page) -> tuple[float, float]:
    """East and north of the pointer, metres, as the page says them."""
    east, north = text(page, "#readout").split(" · ")[0].split(", ")
    return float(east.split()[1]), float(north.split()[1])


def test_keys_on_the_map(open_page: Open) -> None:
    page = open_page()
    page.ask("document.getElementById('map').focus()")
    whole = picture(page)
    for there, back in (("ArrowLeft", "ArrowRight"), ("ArrowUp", "ArrowDown"), ("+", "0"), ("-", "0"), (".", ",")):
        page.press(there)
        assert picture(page) != whole
        page.press(back)
        assert picture(page) == whole


def test_playing_goes_through_the_windows_until_it_is_paused(open_page: Open) -> None:
    page = open_page()
    page.ask("(b => { b.value = '180'; b.dispatchEvent(new Event('change')); })(document.getElementById('pace'))")
    first = page.ask("document.getElementById('window').value")
    page.click("#play")
    assert text(page, "#play") == "Pause"
    page.wait(f"document.getElementById('window').value !== {first!r}")
    page.click("#play")
    assert text(page, "#play") == "Play"
    page.click("#next")
    page.click("#previous")
    slide(page, 99)
    assert page.ask("document.getElementById('window').value") == "5"  # there is no window after the last one


def test_a_click_on_a_chart_or_a_moment_goes_there(open_page: Open) -> None:
    page = open_page()
    chart = "svg.chart[data-left]"
    page.ask(f"document.querySelector({chart!r}).scrollIntoView({{ block: 'center' }})")
    slide(page, 0)
    page.click(chart)
    assert page.ask("document.getElementById('window').value") not in ("0", "5")
    cursor = f"document.querySelector({chart!r}).querySelector('.cursor')"
    assert page.ask(f"{cursor}.getAttribute('visibility')") == "visible"
    slide(page, 5)
    seconds, agent = page.ask("(b => [b.dataset.seconds, b.dataset.agent])(document.querySelector('button[data-seconds]'))")
    page.click("button[data-seconds]")
    assert page.ask("document.activeElement.id") == "map"
    assert text(page, "#moment").endswith(f"window {round((float(seconds) - 40) / 20)}") and agent in ("0", "1")


def test_less_time_around_the_origin_is_less_on_the_map(open_page: Open) -> None:
    page = open_page()
    choices = page.ask("[...document.getElementById('span').options].map(option => Number(option.value))")
    lengths = []
    for share in sorted(choices, reverse=True):
        page.ask(f"(b => {{ b.value = '{share}'; b.dispatchEvent(new Event('change')); }})(document.getElementById('span'))")
        lengths.append(count(page, "past"))
    assert choices[0] == 1 and lengths == sorted(lengths, reverse=True) and lengths[-1] < lengths[0]


def test_a_phone_shows_the_page_without_scrolling_sideways(open_page: Open) -> None:
    page = open_page(width=375, height=700, is_phone=True)
    assert page.ask("document.documentElement.scrollWidth") <= page.ask("window.innerWidth") == 375
    assert page.ask("document.getElementById('map').clientWidth") > 250 and count(page, "future") > 0


def test_a_phone_shows_everything_unfolded_without_scrolling_sideways(open_page: Open, tmp_path: Path) -> None:
    mission = build_mission(tmp_path)
    rename_agents(mission, {"T0": "a_ship_with_a_name_that_nobody_can_pronounce_or_wants_to_read_to_its_very_end"})
    report(mission, ReportConfig(), Progress(quiet=True))
    page = open_page(mission / "report.html", width=390, height=844, is_phone=True)
    page.ask("document.querySelectorAll('details').forEach(part => { part.open = true; })")
    assert page.ask("document.documentElement.scrollWidth") <= page.ask("window.innerWidth") == 390
    # Nothing lies on the list of agents, and the time stands under the map.
    bottom, top = page.ask(
        "[document.querySelector('.panel'), document.querySelector('.moments')].map("
        "(part, i) => i ? part.getBoundingClientRect().top : Math.max(...[...part.querySelectorAll('*')]"
        ".filter(e => !e.closest('ul')).map(e => e.getBoundingClientRect().bottom)))"
    )
    assert bottom < top
    assert page.ask(
        "document.querySelector('.timeline').getBoundingClientRect().bottom"
        " < document.querySelector('.panel').getBoundingClientRect().top"
    )


def test_every_sensor_has_a_track_that_is_seen(open_page: Open, tmp_path: Path) -> None:
    mission = build_mission(tmp_path)
    table, frame = read_table(mission / "poses.parquet", "poses")
    # The name of the first sensor was written before the track of the second was drawn, in its colour.
    column = table.schema.get_field_index("sensor_id")
    other = table.set_column(column, table.schema.field(column), pa.array(["radar"] * table.num_rows, pa.string()))
    y = other.schema.get_field_index("y_m")
    other = other.set_column(y, other.schema.field(y), pc.add(other["y_m"], 150.0))
    write_table(pa.concat_tables([table, other]).sort_by("time_ns"), mission / "poses.parquet", "poses", frame)
    report(mission, ReportConfig(), Progress(quiet=True))
    page = open_page(mission / "report.html")
    for layer in LAYERS:
        if layer != "sensors":
            page.click(f"[data-layer={layer}]")
    slide(page, 5)
    assert min(count_like(page, "sensor")) > 60


def count_like(page: Page, name: str) -> list[int]:
    """Pixels of the map's upper and lower half that are rather the colour than white: a thin line has hardly any pure ones."""
    return page.ask(f"""(() => {{
      const map = document.getElementById("map"), {{ data }} = map.getContext("2d").getImageData(0, 0, map.width, map.height);
      const wanted = getComputedStyle(document.documentElement).getPropertyValue("--{name}").trim().slice(1);
      const [r, g, b] = [0, 2, 4].map(i => parseInt(wanted.slice(i, i + 2), 16)), counts = [0, 0];
      for (let i = 0; i < data.length; i += 4) {{
        const near = (255 - data[i + 1]) / (255 - g);
        if (near > 0.4 && data[i] > data[i + 1] + 20) counts[i < data.length / 2 ? 0 : 1]++;
      }}
      return counts;
    }})()""")


def test_the_picture_of_the_whole_holds_every_band(open_page: Open) -> None:
    page = open_page()
    for layer in LAYERS:
        if layer not in ("past", "future", "envelopes"):
            page.click(f"[data-layer={layer}]")
    page.click("#fit-all")
    edge = """(() => {
      const map = document.getElementById("map"), pen = map.getContext("2d"), { width: w, height: h } = map;
      const colourful = (...side) => {
        const { data: d } = pen.getImageData(...side);
        for (let i = 0; i < d.length; i += 4)
          if (Math.max(...d.slice(i, i + 3)) - Math.min(...d.slice(i, i + 3)) > 8) return true;
        return false;
      };
      return [[0, 0, w, h], [0, 0, w, 1], [0, h - 1, w, 1], [0, 0, 1, h], [w - 1, 0, 1, h]].map(side => colourful(...side));
    })()"""
    for window in range(6):
        slide(page, window)
        assert page.ask(edge) == [True, False, False, False, False], window


def test_no_band_and_no_mean_on_an_island_that_is_passed_on_either_side(open_page: Open, tmp_path: Path) -> None:
    mission = build_mission(tmp_path)
    around_an_island(mission)
    report(mission, ReportConfig(), Progress(quiet=True))
    page = open_page(mission / "report.html")
    page.click("#fit-window")
    whole = island(page)
    assert whole == {"grey"}
    assert "50 % north" in (text(page, ".moments"))
    for layer in ("envelopes", "mean", "past", "future"):
        page.click(f"[data-layer={layer}]")
    assert island(page) == {"grey"}


def around_an_island(mission: Path) -> None:
    """Every hypothesis passes a circle in the middle of its way, the odd ones north of it, the even ones south."""
    table, frame = read_table(mission / "hypotheses.parquet", "hypotheses")
    rows = table.to_pylist()
    steps = np.arange(96)
    bump = np.clip(1 - np.abs(steps - 40) / 15, 0, 1)
    for row in rows:
        side = 1 if row["hypothesis"] % 2 else -1
        away = side * (70 + 0.5 * row["hypothesis"]) * bump
        row |= {"weight": 1 / 12, "datum_x_m": 0.0, "datum_y_m": 0.0}
        row["position_m"] = np.column_stack([5.0 * steps, away]).tolist()
    write_table(pa.Table.from_pylist(rows, schema=table.schema), mission / "hypotheses.parquet", "hypotheses", frame)
    island = {"kind": "circle", "x_m": 200.0, "y_m": 0.0, "radius_m": 40.0}
    (mission / "obstacles.json").write_text(json.dumps({"version": 1, "obstacles": [island]}))


def island(page: Page) -> set[str]:
    """What colours are seen along the middle of the island, of which the map's readout tells the place."""
    page.ask("document.getElementById('map').scrollIntoView({ block: 'center' })")
    x, y = page.middle("#map")
    page.mouse("mouseMoved", x, y)
    first = place(page)
    page.mouse("mouseMoved", x + 100, y)
    pixel_per_m = 100 / (place(page)[0] - first[0])
    at = x + (200 - first[0]) * pixel_per_m, y + (first[1] - 0) * pixel_per_m
    return set(
        page.ask(f"""(() => {{
          const map = document.getElementById("map"), box = map.getBoundingClientRect(), pen = map.getContext("2d");
          const reach = Math.floor(30 * {pixel_per_m});
          const {{ data }} = pen.getImageData({at[0]} - box.left - reach, {at[1]} - box.top - reach / 2, 2 * reach, reach);
          const found = new Set();
          for (let i = 0; i < data.length; i += 4)
            found.add(Math.max(...data.slice(i, i + 3)) - Math.min(...data.slice(i, i + 3)) < 12 ? "grey" : "colour");
          return [...found];
        }})()""")
    )


def test_of_many_agents_some_are_listed_and_any_is_found(
    open_page: Open, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fixture, "AGENT_IDS", tuple(f"ship {number:03}" for number in range(70)))
    monkeypatch.setattr(fixture, "NUM_HYPOTHESES", 2)
    mission = build_mission(tmp_path, num_hypotheses=2)
    report(mission, ReportConfig(), Progress(quiet=True))
    page = open_page(mission / "report.html")
    listed = "[...document.querySelectorAll('#agents li')].filter(item => item.offsetParent).length"
    assert page.ask(listed) == 60 and "60 of 70 agents listed" in text(page, "#agent-count")
    page.ask("(b => { b.value = '069'; b.dispatchEvent(new Event('input')); })(document.getElementById('search'))")
    assert page.ask(listed) == 1 and "1 of 70 agents" in text(page, "#agent-count")
    page.click("#none")
    assert count(page, "past") == 0
    page.click("#agents li:nth-child(70) button")
    assert count(page, "past") > 0
    few = open_page()
    assert few.ask("document.getElementById('search').offsetParent") is None


def test_an_agent_is_drawn_as_strongly_as_it_is_likely(open_page: Open, tmp_path: Path) -> None:
    mission = build_mission(tmp_path)
    make_uncertain(mission, {"T0": 0.3, "T1": 0.999})
    report(mission, ReportConfig(), Progress(quiet=True))
    page = open_page(mission / "report.html")
    assert page.ask("[...document.querySelectorAll('#agents input')].map(box => box.checked)") == [False, True]
    assert text(page, "#agents li:nth-child(1) span").startswith("30 %") and "not ticked" in text(page, ".panel")
    page.click("#agents li:nth-child(2) input")
    assert count(page, "past") == 0
    page.click("#agents li:nth-child(1) input")
    assert count(page, "past") == 0  # faint: none of its pixels has the full colour
    page.click("#agents li:nth-child(2) input")
    assert count(page, "past") > 0


def test_dark_mode_and_paper(open_page: Open) -> None:
    corner = "[...document.getElementById('map').getContext('2d').getImageData(2, 2, 1, 1).data]"
    page = open_page(is_dark=True)
    assert page.ask(corner) == [0x19, 0x1F, 0x27, 255]
    assert page.ask("getComputedStyle(document.body).backgroundColor") == "rgb(17, 21, 27)"
    assert count(page, "future") > 0
    page.ask("dispatchEvent(new Event('beforeprint'))")
    assert page.ask(corner) == [255, 255, 255, 255]
    page.ask("dispatchEvent(new Event('afterprint'))")
    assert page.ask(corner) == [0x19, 0x1F, 0x27, 255]
    assert open_page().ask(corner) == [255, 255, 255, 255]


def test_what_a_log_names_itself_stays_text_in_the_browser(open_page: Open, tmp_path: Path) -> None:
    name = "</script><img src=x onerror=alert(1)>"
    mission = build_mission(tmp_path)
    rename_agents(mission, {"T0": name})
    report(mission, ReportConfig(), Progress(quiet=True))
    page = open_page(mission / "report.html")
    assert page.ask("document.images.length") == 0 and page.ask("document.scripts.length") == 2
    assert name in page.ask("[...document.querySelectorAll('#agents button')].map(button => button.textContent)")


def test_a_mission_without_hypotheses_has_a_map_of_its_detections(open_page: Open, tmp_path: Path) -> None:
    mission = build_mission(tmp_path)
    table, frame = read_table(mission / "hypotheses.parquet", "hypotheses")
    write_table(table.slice(0, 0), mission / "hypotheses.parquet", "hypotheses", frame)
    report(mission, ReportConfig(), Progress(quiet=True))
    page = open_page(mission / "report.html")
    assert count(page, "future") == count(page, "past") == 0
    with_detections = picture(page)
    page.click("[data-layer=everywhere]")
    assert picture(page) != with_detections


BALLS = """(() => {
  const map = document.getElementById("whole-map"), { data } = map.getContext("2d").getImageData(0, 0, map.width, map.height);
  let [count, x, y] = [0, 0, 0];
  for (let i = 0; i < map.width * map.height; i++) {
    if (data[4 * i + 3] > 200) { count++; x += i % map.width; y += Math.floor(i / map.width); }
  }
  return [count, x / count / map.width, y / count / map.height];
})()"""


def test_mission_hypotheses_move_over_the_whole_map(open_page: Open, tmp_path: Path) -> None:
    directory = asked_mission(tmp_path)
    report(directory, ReportConfig(), Progress(quiet=True))
    page = open_page(directory / "report.html")
    still = page.ask("document.querySelector('svg.whole').outerHTML")
    begin = "s = document.getElementById('whole-time'); s.value = {}; s.dispatchEvent(new Event('input'))"
    seen = {}
    for at in (0, 250, 500):
        page.ask(begin.format(at))
        seen[at] = page.ask(BALLS)
        assert text(page, "#whole-moment") == f"2023-11-14 22:{13 + (20 + at // 5) // 60}:{(20 + at // 5) % 60:02} UTC"
    # T0 comes from the west and T1 from the south; after half of the time both are in the middle, as one ball.
    assert seen[500][1:] == pytest.approx([0.5, 0.5], abs=0.03) and 20 < seen[500][0] < 0.7 * seen[250][0]
    assert seen[0][1] < 0.45 and seen[0][2] > 0.55 and seen[0][1] < seen[250][1] < seen[500][1]
    paces = page.ask("[...document.getElementById('whole-pace').options].map(option => Number(option.value))")
    assert paces == [1, 10, 60, 300, 600]
    page.ask(begin.format(0))
    page.ask("p = document.getElementById('whole-pace'); p.value = 60; p.dispatchEvent(new Event('change'))")
    page.click("#whole-play")
    page.wait("Number(document.getElementById('whole-time').value) > 100")
    page.click("#whole-play")
    assert text(page, "#whole-play") == "Play" and page.ask(BALLS)[1] > seen[0][1]
    assert page.ask("document.querySelector('svg.whole').outerHTML") == still, "lines, obstacles and detections stay"
