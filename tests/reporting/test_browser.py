"""The report in a headless browser; ``pip install "bayesperiodic[browser]"`` and ``playwright install chromium``."""

import json
import re
import shutil

import numpy as np
import pytest

from tests.reporting.conftest import NAME
from tests.reporting.reading import value

playwright = pytest.importorskip("playwright.sync_api", reason='no playwright: pip install "bayesperiodic[browser]"')
axe = pytest.importorskip(
    "axe_playwright_python.sync_playwright", reason='no axe: pip install "bayesperiodic[browser]"'
)

INSTALLED = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "msedge")
SIZES = {"desktop": (1200, 900), "phone": (360, 740)}


@pytest.fixture(scope="module")
def browser():
    """Return playwright's Chromium, or one that is installed on the machine."""
    with playwright.sync_playwright() as started:
        found = next(filter(None, map(shutil.which, INSTALLED)), None)
        try:
            opened = started.chromium.launch()
        except playwright.Error:
            if found is None:
                pytest.skip("no browser: playwright install chromium, or have chromium or google-chrome on the path")
            opened = started.chromium.launch(executable_path=found)
        yield opened
        opened.close()


@pytest.fixture(params=["written", "hostile", "several_written"])
def path(request):
    return request.getfixturevalue(request.param)


@pytest.fixture
def open_page(browser, path):
    """Return a function that opens the report offline; requests, messages and dialogs are collected on the page."""
    contexts = []

    def open_it(size="desktop", scheme="light", **options):
        width, height = SIZES[size]
        options |= {"offline": True, "viewport": {"width": width, "height": height}, "color_scheme": scheme}
        context = browser.new_context(**options)
        contexts.append(context)
        page = context.new_page()
        page.seen = []
        page.on("request", lambda request: page.seen.append(request.url.partition(":")[0]))
        page.on("console", lambda message: page.seen.append(f"console {message.text}"))
        page.on("pageerror", lambda error: page.seen.append(f"error {error}"))
        page.on("dialog", lambda dialog: (page.seen.append("dialog"), dialog.dismiss()))
        page.goto(path.as_uri())
        return page

    yield open_it
    for context in contexts:
        context.close()


@pytest.mark.parametrize("size", SIZES)
def test_report_opens_offline_without_messages_and_shows_all_pictures(open_page, size):
    page = open_page(size)
    pictures = page.locator(".picture").evaluate_all(
        "all => all.map(p => [p.shadowRoot.querySelectorAll('path').length, p.clientWidth, p.clientHeight])"
    )
    assert len(pictures) == page.locator("figure").count() >= 2 and page.locator("img").count() == 0
    assert all(paths > 20 and width > 200 and height > 100 for paths, width, height in pictures)
    assert set(page.seen) <= {"file", "data"}
    assert page.locator("h1").count() == 1 and page.locator("table").count() >= 7


@pytest.mark.parametrize("size", SIZES)
def test_report_fits_the_width_of_the_screen(open_page, size):
    page = open_page(size)
    width = SIZES[size][0]
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    outside = """all => all.filter(e => e.getRootNode() === document && !e.closest('.scroll, .plate, pre, .skip'))
        .filter(e => e.getBoundingClientRect().right > innerWidth + 1).map(e => e.outerHTML.slice(0, 80))"""
    assert page.locator("body *").evaluate_all(outside) == []


@pytest.mark.parametrize("path", ["written", "several_written"], indirect=True)
def test_printed_tables_and_figures_fit_the_paper(open_page):
    """The printable width of A4 is 19 cm, at 96 pixels per inch 718 pixels."""
    page = open_page()
    page.set_viewport_size({"width": 718, "height": 1000})
    page.emulate_media(media="print")
    right = page.locator("table, .picture").evaluate_all("all => all.map(e => e.getBoundingClientRect().right)")
    assert max(right) <= 719 and page.locator(".choice, .reading").locator("visible=true").count() == 0


def test_equations_are_typeset_by_the_browser(open_page):
    page = open_page()
    tall = page.locator(".equations math").evaluate_all("all => all.map(m => m.getBoundingClientRect().height)")
    assert len(tall) in (2, 3) and all(10 < height < 200 for height in tall)
    dot, letter = page.locator(".equations mover").first.evaluate(
        "m => [...m.children].map(c => c.getBoundingClientRect().top)"
    )[::-1]
    assert dot < letter


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", SIZES)
def test_report_passes_the_accessibility_check(open_page, size, scheme):
    """All rules of axe-core, contrast among them."""
    page = open_page(size, scheme)
    found = axe.Axe().run(page)
    assert found.violations_count == 0, found.generate_report()


def test_dark_mode_is_dark_and_the_keyboard_reaches_everything(open_page):
    page = open_page(scheme="dark")
    assert page.locator("body").evaluate("b => getComputedStyle(b).backgroundColor") == "rgb(18, 22, 26)"
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.className") == "skip"
    page.keyboard.press("Enter")
    assert page.evaluate("location.hash") == "#content"


ONE, SEVERAL = (pytest.mark.parametrize("path", [name], indirect=True) for name in ("written", "several_written"))


READ = r"(measured|MAP|residual \[[^]]+\]:) (\S+?)(?:[,;]|$)"


def readings(text):
    """Return the numbers that follow the names of curves in a text that was read from a figure."""
    return {name: value(number) for name, number in re.findall(READ, text)}


def assert_read(text, problem, fit, experiment, channel, at):
    """Check that a text states experiment, time, and four digits of the measured and fitted values with their units."""
    run = next(e for e in problem.experiments if e.name == experiment)
    unit, residual = problem.units[channel], fit.residuals[experiment][channel][at]
    assert text.startswith(f"{experiment}, time in the period [s]: ") and f"; {channel} [{unit}]: measured " in text
    time = text.removeprefix(f"{experiment}, time in the period [s]: ").partition(";")[0]
    assert value(time) == pytest.approx(run.time[at], rel=1e-3, abs=1e-6)
    y = run.outputs[channel][at]
    wanted = {"measured": y, "MAP": y - residual, f"residual [{unit}]:": residual}
    assert readings(text) == pytest.approx(wanted, rel=6e-4, abs=1e-5 * np.ptp(run.outputs[channel]))


@ONE
def test_values_are_read_by_keyboard_and_said_to_screen_readers(open_page, solved):
    problem, fit, _ = solved
    page = open_page()
    slider = page.locator("#figure-fit-1").get_by_role("slider", name="Point to read")
    slider.focus()
    for key, at in (("Home", 0), ("ArrowRight", 1), ("ArrowRight", 2), ("End", 39), ("ArrowLeft", 38)):
        page.keyboard.press(key)
        text = slider.get_attribute("aria-valuetext")
        assert_read(text, problem, fit, "run", "force", at)
        assert page.locator("#figure-fit-1 .reading p").inner_text() == text
    assert "90 % predictive band" in text
    assert page.locator("#figure-fit-1 .picture").evaluate("p => p.shadowRoot.querySelectorAll('circle').length") > 3


@SEVERAL
def test_values_are_read_by_pointer_and_touch_where_they_are_drawn(open_page, several):
    """In a panel of one experiment the time decides, whatever the height of the pointer."""
    problem, fit = several
    page = open_page("phone", has_touch=True)
    for number, run, at in ((1, problem.experiments[0], 120), (2, problem.experiments[1], 60)):
        figure = page.locator(f"#figure-fit-{number}")
        figure.scroll_into_view_if_needed()
        panels = json.loads(figure.get_attribute("data-panels"))
        panel = next(p for p in panels if p["y"]["label"].startswith("rate"))
        (low, high), (left, top, right, bottom) = panel["x"]["limits"], panel["box"]
        x = left + (right - left) * (run.time[at] - low) / (high - low)
        picture = figure.locator(".picture")
        width = picture.evaluate("p => Number(p.shadowRoot.querySelector('svg').getAttribute('viewBox').split(' ')[2])")
        for height, point in ((0.2, picture.hover), (0.7, picture.tap)):
            scale = picture.bounding_box()["width"] / width
            point(position={"x": x * scale, "y": (top + height * (bottom - top)) * scale})
            assert_read(figure.locator(".reading p").inner_text(), problem, fit, run.name, "rate", at)


@ONE
def test_corner_is_read_by_its_axes(open_page, solved):
    _, fit, posterior = solved
    page = open_page()
    figure = page.locator("#figure-corner")
    panel = next(p for p in json.loads(figure.get_attribute("data-panels")) if p["x"] and p["y"])
    left, top, right, bottom = panel["box"]
    picture = figure.locator(".picture")
    width = picture.evaluate("p => Number(p.shadowRoot.querySelector('svg').getAttribute('viewBox').split(' ')[2])")
    scale = picture.bounding_box()["width"] / width
    picture.hover(position={"x": 0.5 * (left + right) * scale, "y": (0.75 * top + 0.25 * bottom) * scale})
    across, up = figure.locator(".reading p").inner_text().split("; ")
    for text, axis, part in ((across, "x", 0.5), (up, "y", 0.75)):
        label, number = text.rsplit(": ", 1)
        low, high = panel[axis]["limits"]
        assert label == panel[axis]["label"] and label.endswith("]")
        assert value(number) == pytest.approx(low + part * (high - low), abs=0.01 * (high - low))


def displayed(page):
    """Return experiment, channel and curve of all that can be seen in the figures."""
    return page.locator("figure").evaluate_all(
        """all => all.filter(f => !f.hidden).flatMap(f => JSON.parse(f.dataset.panels).flatMap(p => p.curves)
            .filter(c => f.querySelector('.picture').shadowRoot.getElementById(c.id).getClientRects().length)
            .map(c => [c.experiment, c.channel, c.curve].join('|')))"""
    )


@SEVERAL
def test_experiments_channels_and_curves_are_chosen_by_keyboard(open_page):
    page = open_page()
    status, every = page.locator(".choice [role=status]"), displayed(page)
    assert status.inner_text() == "Shown: 2 of 2 experiments, 2 of 2 channels, 3 of 3 curves"
    for label, field in (("whole", 0), (NAME, 0), ("rate", 1), ("MAP", 2)):
        box = page.locator(".choice").get_by_role("checkbox", name=label, exact=True)
        box.focus()
        page.keyboard.press("Space")
        assert not box.is_checked() and status.inner_text().count("1 of 2") == (field < 2)
        assert sorted(displayed(page)) == sorted(name for name in every if name.split("|")[field] != label)
        page.keyboard.press("Space")
        assert displayed(page) == every
    page.get_by_label("whole", exact=True).uncheck()
    assert page.locator("#figure-fit-1").is_hidden() and page.locator("#figure-fit-2").is_visible()


@SEVERAL
def test_hidden_channels_are_neither_read_nor_take_space(open_page):
    page = open_page()
    figure = page.locator("#figure-fit-2")
    before, slider = figure.locator(".picture").bounding_box(), figure.get_by_role("slider")
    assert slider.get_attribute("max") == "39"
    page.get_by_label("angle", exact=True).uncheck()
    after = figure.locator(".picture").bounding_box()
    assert after["width"] == before["width"] and 0.4 < after["height"] / before["height"] < 0.6
    assert slider.get_attribute("max") == "19" and "; rate [" in slider.get_attribute("aria-valuetext")


@ONE
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", ["fit-1", "corner"])
def test_figures_are_enlarged_and_reset_by_buttons_and_keys(open_page, name, size):
    page = open_page(size)
    figure = page.locator(f"#figure-{name}")
    picture, plate, shown = figure.locator(".picture"), figure.locator(".plate"), figure.get_by_role("status")
    width, height = (picture.bounding_box()["width"], plate.bounding_box()["height"])

    def enlarged():
        assert page.evaluate("document.documentElement.scrollWidth") <= SIZES[size][0]
        assert plate.bounding_box()["height"] == pytest.approx(height, abs=1.0)
        return picture.bounding_box()["width"] / width

    for act in (lambda name: figure.get_by_role("button", name=name).press("Enter"), None):
        steps = {"Zoom in": 1.5, "Zoom out": 1.0} if act else {"+": 1.5, "-": 1.0}
        for step, scale in (*steps.items(), ("Zoom in" if act else "+", 1.5), ("Reset" if act else "0", 1.0)):
            act(step) if act else plate.press(step)
            assert enlarged() == pytest.approx(scale, abs=0.01)
            assert shown.inner_text() == f"{100 * scale:.0f} %"
    for _ in range(9):
        plate.press("+")
    assert enlarged() == pytest.approx(12.0, abs=0.05)
    page.emulate_media(media="print")
    assert picture.bounding_box()["width"] <= SIZES[size][0] and figure.locator(".reading").is_hidden()


@SEVERAL
def test_everything_that_acts_is_reached_by_tab_with_a_visible_focus(open_page):
    page = open_page()
    reached = []
    for _ in range(100):
        page.keyboard.press("Tab")
        reached.append(
            page.evaluate(
                """() => { const e = document.activeElement, s = getComputedStyle(e);
                return [e.closest('figure')?.id ?? e.parentElement.className, e.type ?? e.className, s.outlineStyle,
                        parseFloat(s.outlineWidth)]; }"""
            )
        )
        if reached[-1][:2] == ["figure-fit-2", "range"]:
            break
    assert [kind for place, kind, *_ in reached if place == "figure-fit-2"] == ["plate", *["button"] * 3, "range"]
    assert sum(kind == "checkbox" for _, kind, *_ in reached) == 7
    assert all(style == "solid" and width >= 2 for _, _, style, width in reached)


@SEVERAL
def test_report_is_the_same_without_scripts(open_page):
    plain, active = open_page(java_script_enabled=False), open_page()
    assert plain.locator("img").count() == plain.locator("figure").count() == active.locator(".picture").count()
    assert plain.locator("button, input, output").count() == 0
    alts = plain.locator("img").all()
    names = [p.get_attribute("aria-label") for p in active.locator(".picture").all()]
    assert names == [image.get_attribute("alt") for image in alts] and all(names)
    for image, picture in zip(alts, active.locator(".picture").all(), strict=True):
        before, after = image.bounding_box(), picture.bounding_box()
        assert [after["width"], after["height"]] == pytest.approx([before["width"], before["height"]], abs=1.0)
    active.evaluate("document.querySelectorAll('.reading, .choice').forEach(e => e.remove())")
    assert active.locator("body").inner_text() == plain.locator("body").inner_text()


@pytest.mark.parametrize("path", ["hostile"], indirect=True)
def test_names_stay_text_and_no_other_script_runs(open_page):
    page = open_page()
    assert page.locator(".choice").get_by_role("checkbox", name=NAME, exact=True).count() == 1
    slider = page.locator("#figure-fit-1").get_by_role("slider")
    assert slider.get_attribute("aria-valuetext").startswith(f"{NAME}, time in the period [s]: 0; force [<b>N</b>]: ")
    assert page.locator(".picture script, .choice script, .choice img, .reading img").count() == 0
    page.evaluate(
        """() => { const s = document.createElement('script'); s.textContent = 'window.ran = true';
        document.body.append(s); }"""
    )
    assert page.evaluate("window.ran") is None and "Content Security Policy" in " ".join(page.seen)


@ONE
def test_nothing_moves_where_less_motion_is_preferred(open_page):
    for motion, behaviour in (("reduce", "auto"), ("no-preference", "smooth")):
        page = open_page(reduced_motion=motion)
        assert page.evaluate("getComputedStyle(document.documentElement).scrollBehavior") == behaviour
        assert page.evaluate("document.getAnimations().length") == 0


@SEVERAL
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_report_passes_the_accessibility_check_while_it_is_used(open_page, scheme):
    page = open_page("phone", scheme)
    page.get_by_label("rate", exact=True).uncheck()
    page.locator("#figure-fit-1").get_by_role("button", name="Zoom in").click()
    page.locator("#figure-fit-1").get_by_role("slider").press("ArrowRight")
    results = axe.Axe().run(page)
    assert results.violations_count == 0, results.generate_report()
