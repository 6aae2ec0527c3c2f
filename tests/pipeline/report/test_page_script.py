"""The page's script in a browser: what a person does on the page, and what the map shows then."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from fixtures.browser import Browser, NoBrowser, Page, chromium
from fixtures.mission import GEOREFERENCED, build_mission, rename_agents

from pipeline.progress import Progress
from pipeline.report.stage import ReportConfig, report
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
