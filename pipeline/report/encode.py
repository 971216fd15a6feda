"""Pictures as text inside a page: JPEG and PNG as data URIs, charts as inline SVG that follows the page's colours."""

from __future__ import annotations

import base64
import io
import re

import cv2
import matplotlib as mpl
import numpy as np
from jaxtyping import UInt8
from markupsafe import Markup
from matplotlib.figure import Figure

__all__ = ["INK", "jpeg_uri", "png_uri", "svg_inline"]

# Stands for the text colour of the page while matplotlib draws; becomes currentColor.
INK = "#010203"
_JPEG_QUALITY = 82


def jpeg_uri(image_bgr: UInt8[np.ndarray, "H W 3"], width_px: int | None = None) -> str:
    """A photograph, scaled down to `width_px` where it is wider."""
    if width_px is not None and image_bgr.shape[1] > width_px:
        height = round(image_bgr.shape[0] * width_px / image_bgr.shape[1])
        image_bgr = cv2.resize(image_bgr, (width_px, height), interpolation=cv2.INTER_AREA)
    done, data = cv2.imencode(".jpg", image_bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    assert done, "OpenCV encodes every uint8 image"
    return _uri("image/jpeg", data.tobytes())


def png_uri(figure: Figure) -> str:
    """A figure with too many points for SVG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return _uri("image/png", buffer.getvalue())


def svg_inline(figure: Figure, name: str, description: str) -> Markup:
    """A chart as an `<svg>` element; `name` keeps its ids apart from other charts of the page."""
    buffer = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'(id="|url\(#|href="#)', rf"\g<1>{name}-", text)
    text = re.sub(r"font: ([^;\"]*)'DejaVu Sans'[^;\"]*", r"font: \1system-ui, sans-serif", text)
    text = text.replace(INK, "currentColor")
    # The width follows the page; the view box keeps the proportions.
    text = re.sub(r'<svg ([^>]*?)width="[^"]*"', r"<svg \1", text, count=1)
    text = re.sub(r'<svg ([^>]*?)height="[^"]*"', r"<svg \1", text, count=1)
    label = Markup.escape(description)
    return Markup(text.replace("<svg ", f'<svg role="img" aria-label="{label}" ', 1))  # noqa: S704 (our own SVG)


def _uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
