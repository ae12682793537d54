"""The report in a headless browser; ``pip install "bayesperiodic[browser]"`` and ``playwright install chromium``."""

import shutil

import pytest

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


@pytest.fixture(params=["written", "hostile"])
def path(request):
    return request.getfixturevalue(request.param)


@pytest.fixture
def open_page(browser, path):
    """Return a function that opens the report offline; requests, messages and dialogs are collected on the page."""
    contexts = []

    def open_it(size="desktop", scheme="light"):
        width, height = SIZES[size]
        context = browser.new_context(offline=True, viewport={"width": width, "height": height}, color_scheme=scheme)
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
    pictures = page.locator("img").evaluate_all("all => all.map(i => [i.complete, i.naturalWidth, i.width])")
    assert len(pictures) >= 5 and all(
        complete and natural > 100 and width > 200 for complete, natural, width in pictures
    )
    assert set(page.seen) <= {"file", "data"}
    assert page.locator("h1").count() == 1 and page.locator("table").count() >= 9


@pytest.mark.parametrize("size", SIZES)
def test_report_fits_the_width_of_the_screen(open_page, size):
    page = open_page(size)
    width = SIZES[size][0]
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    outside = """all => all.filter(e => !e.closest('.scroll, .plate, pre, .skip'))
        .filter(e => e.getBoundingClientRect().right > innerWidth + 1).map(e => e.outerHTML.slice(0, 80))"""
    assert page.locator("body *").evaluate_all(outside) == []


def test_equations_are_typeset_by_the_browser(open_page):
    page = open_page()
    tall = page.locator(".equations math").evaluate_all("all => all.map(m => m.getBoundingClientRect().height)")
    assert len(tall) == 2 and all(10 < height < 200 for height in tall)
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
