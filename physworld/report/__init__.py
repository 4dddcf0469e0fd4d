"""The page of a trace: one self-contained HTML file with pictures, from a report, its scene and its tracks."""

from physworld.report.page import render

__all__ = ["render"]
