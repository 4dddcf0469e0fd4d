"""The page of a trace: one self-contained HTML file with pictures, from a report, its scene and its tracks."""

from physworld.trace.html.page import render

__all__ = ["render"]
