"""The report in a real browser, offline, at desktop and phone width."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pendulum_bags.report import write_report
from tests.synthetic_runs import write_run_folder

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
SWITCHES = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
WIDTHS = {"desktop": 1280, "phone": 390}

pytestmark = pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_run_folder(tmp_path_factory.mktemp("browser") / "run", seed=1)
    return write_report(folder, recordings=[], formats=["png"])


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as running:
        opened = running.chromium.launch(executable_path=BROWSER, args=SWITCHES)
        yield opened
        opened.close()


@pytest.fixture(params=WIDTHS)
def page(request: pytest.FixtureRequest, browser: Any, report: Path) -> Iterator[Any]:
    context = browser.new_context(viewport={"width": WIDTHS[request.param], "height": 900}, offline=True)
    opened = context.new_page()
    opened.messages = []
    opened.on("console", lambda message: opened.messages.append(message.text))
    opened.on("pageerror", lambda error: opened.messages.append(str(error)))
    opened.goto(report.resolve().as_uri())
    opened.wait_for_function("document.documentElement.dataset.ready === 'true'", timeout=60_000)
    yield opened
    context.close()


def test_page_is_whole_and_usable(page: Any) -> None:
    # One visit for all that is seen at one width: loading takes seconds on a small machine.
    assert page.messages == []
    plots = page.locator(".graph")
    assert plots.count() >= 20
    assert page.locator(".graph .main-svg").count() >= plots.count()
    drawn = "nodes => nodes.every(n => n.querySelector('.xy path, .xy g.points path, .scatterlayer path'))"
    assert plots.evaluate_all(drawn)
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    outside = "nodes => nodes.filter(n => n.getBoundingClientRect().right > window.innerWidth + 1).length"
    assert page.locator("header, figure, .graph").evaluate_all(outside) == 0
    assert page.locator("#failure").is_hidden()

    # Names of rows leave half of the width to the rows, on a phone too.
    share = "n => n._fullLayout._size.w / n._fullLayout.width"
    assert page.locator('[data-graph="equivalence-0"]').evaluate(share) > 0.45

    # The result of a test stands beside its name, inside the screen; on a phone every other cell is labelled.
    tests = page.locator("figure.table", has=page.locator("h3:text-is('Tests against the margins')"))
    for row in tests.locator("tbody tr").all():
        name, result = row.locator("th").bounding_box(), row.locator("td.result").bounding_box()
        assert result["x"] + result["width"] <= page.viewport_size["width"]
        assert abs(result["y"] - name["y"]) < 2.0
    cut = "nodes => nodes.filter(n => n.scrollWidth > n.clientWidth + 1).map(n => n.ariaLabel)"
    assert page.locator(".scroll").evaluate_all(cut) == []
    label = "n => getComputedStyle(n, '::before').content"
    narrow = page.viewport_size["width"] == WIDTHS["phone"]
    first = tests.locator("tbody tr").first.locator("td")
    assert first.first.evaluate(label) == ('"estimate"' if narrow else "none")
    assert tests.locator("td.result").first.evaluate(label) == "none"
    assert tests.locator("td.result").first.inner_text() in {"equivalent", "not equivalent", "undecided"}

    # Headings that are labels already take no room on a phone.
    heading = "n => n.querySelector('tbody').getBoundingClientRect().y - n.getBoundingClientRect().y"
    assert (tests.locator("table").evaluate(heading) < 5.0) == narrow

    # Long tables open at a click, and not before.
    metrics = page.locator("figure.table", has=page.locator("h3:text-is('Metrics of the regulation')"))
    assert metrics.locator("table").is_hidden()
    assert tests.locator("table").is_visible()
    metrics.locator("summary").click()
    assert metrics.locator("table").is_visible()
    assert page.locator(".scroll").evaluate_all(cut) == []
    # Before the page is printed all are open; then those again that the reader opened.
    shut = page.locator("details:not([open])")
    before = shut.count()
    assert before >= 1
    page.evaluate("window.dispatchEvent(new Event('beforeprint'))")
    assert shut.count() == 0
    page.evaluate("window.dispatchEvent(new Event('afterprint'))")
    assert shut.count() == before
    assert metrics.locator("table").is_visible()

    # By keyboard: a plot takes the focus, zooms, moves and comes back.
    plot = page.locator('[data-graph="both_together-0"]')
    plot.focus()
    span = "(n => n._fullLayout.xaxis.range[1] - n._fullLayout.xaxis.range[0])"
    before = plot.evaluate(span)
    node = plot.element_handle()
    page.keyboard.press("+")
    page.wait_for_function(f"([n, before]) => {span}(n) < 0.8 * before", arg=[node, before])
    page.keyboard.press("0")
    page.wait_for_function(f"([n, before]) => Math.abs({span}(n) / before - 1) < 0.02", arg=[node, before])

    # The animation runs from its button, also where the browser began the next picture before the press.
    page.evaluate("{ const now = performance.now.bind(performance); performance.now = () => now() + 200; }")
    page.locator("#play").focus()
    page.keyboard.press("Enter")
    page.wait_for_function("Number(document.getElementById('seek').value) > 2")
    page.keyboard.press("Enter")
    page.wait_for_function("document.getElementById('play').innerText === 'Play'")
    assert page.messages == []


@pytest.mark.parametrize("scripts", [True, False], ids=["with scripts", "without scripts"])
def test_paper_shows_every_figure_as_a_picture(browser: Any, report: Path, scripts: bool) -> None:
    assert report.stat().st_size < 5_000_000
    context = browser.new_context(offline=True, java_script_enabled=scripts)
    page = context.new_page()
    page.goto(report.resolve().as_uri())
    # At once, as a browser that prints from the command line does: before any plot is drawn.
    page.emulate_media(media="print")
    figures = page.locator("figure:has(.graphs)")
    assert figures.count() >= 12
    for index in range(figures.count()):
        picture = figures.nth(index).locator("img.paper")
        box = picture.bounding_box()
        assert box is not None
        assert box["width"] > 300
        assert box["height"] > 100
        assert figures.nth(index).locator(".graphs").is_hidden()
    # What is folded on a screen is all there.
    tables = page.locator("figure.table table")
    assert page.locator("details table").count() >= 2
    assert all(one.bounding_box()["height"] > 40 for one in tables.all())
    assert page.locator("summary").first.is_hidden()
    context.close()
