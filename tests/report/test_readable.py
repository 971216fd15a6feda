"""Pages can be read: by their colours, light and dark, and on a phone."""

import re
from itertools import product
from pathlib import Path

import numpy as np
import pytest

STYLE = (Path(__file__).parent.parent.parent / "pipeline" / "report" / "templates" / "base.html").read_text()
SCHEMES = dict(zip(("light", "dark"), re.findall(r":root \{(.*?)\}", STYLE, re.DOTALL), strict=True))
# What is written on what: names of colours without --.
ON = {
    "ink": ("bg", "card", "none-bg", "good-bg", "partly-bg", "bad-bg"),
    "soft": ("bg", "card", "none-bg"),
    "link": ("bg", "card", "none-bg"),
    "good": ("good-bg", "bg", "card"),
    "partly": ("partly-bg", "bg", "card"),
    "bad": ("bad-bg", "bg", "card"),
}
PAIRS = [
    (scheme, text, ground) for scheme, (text, grounds) in product(SCHEMES, ON.items()) for ground in grounds
]


def luminance(colour):
    """Relative luminance of #rgb or #rrggbb by WCAG 2.1."""
    digits = colour.removeprefix("#")
    digits = "".join(2 * c for c in digits) if len(digits) == 3 else digits
    channels = np.array([int(digits[i : i + 2], 16) for i in (0, 2, 4)]) / 255
    linear = np.where(channels <= 0.03928, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def contrast(a, b):
    low, high = sorted((luminance(a), luminance(b)))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize(("scheme", "text", "ground"), PAIRS)
def test_text_stands_out_from_its_ground_by_at_least_wcag_aa(scheme, text, ground):
    colours = dict(re.findall(r"--([\w-]+):(#\w+)", SCHEMES[scheme]))
    assert contrast(colours[text], colours[ground]) >= 4.5
