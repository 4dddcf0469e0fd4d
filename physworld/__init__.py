"""PhysWorld, the science: arrays in, arrays out; no files, no HTTP, no queue.

World frame z up; metres, seconds, kilograms; axis order time, entity, xyz.
"""

__version__ = "0.2.0"
