"""Contrast of the page's colours by the formula of WCAG 2.2 (www.w3.org/TR/WCAG22, relative luminance)."""

import re
from importlib.resources import files

import pytest

STYLE = (files("bayesperiodic.reporting") / "templates" / "page.css").read_text(encoding="utf-8")
PAIRS = [
    *((front, back) for front in ("text", "soft", "link") for back in ("page", "panel")),
    *((tone, f"{tone}-back") for tone in ("good", "caution", "bad", "neutral")),
]


def luminance(colour: str) -> float:
    channels = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one: str, other: str) -> float:
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


def test_contrast_formula_gives_published_ratios():
    """Black on white is 21:1, and #767676 the lightest grey that passes on white (WebAIM: 4.54:1)."""
    assert contrast("#000000", "#ffffff") == pytest.approx(21.0)
    assert contrast("#767676", "#ffffff") == pytest.approx(4.54, abs=0.005)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_all_text_has_enough_contrast(scheme):
    blocks = re.findall(r":root \{(.*?)\}", STYLE, re.DOTALL)
    colours = dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6});", blocks[scheme == "dark"]))
    low = {pair: contrast(*(colours[name] for name in pair)) for pair in PAIRS}
    assert min(low.values()) >= 4.5, low
