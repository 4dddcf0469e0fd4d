"""Recordings of known truth as a depth camera would see them, and what the tracker makes of them.

``python -m benchmarks.tracking render beam OUT --cameras 3`` writes a recording in PhysTwin's layout with its truth;
``python -m benchmarks.tracking measure OUT`` tracks it and prints points alive and errors against the frame.
"""
