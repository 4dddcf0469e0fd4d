"""What a tracking's process and the handler that starts it have in common: names of files, limits, exit statuses."""

from __future__ import annotations

from physworld_scenes.limited import Limits

UPLOAD, REQUEST, FOUND = "upload", "request.json", "found.json"
ARCHIVE, LOOK, CAMERA, FRAMES = "scene.zip", "followed.png", "camera.json", "frames.npz"
VIEWS = "views.npz"
"""What the first frame shows of the object, where a splat is asked for: the handler fits it."""
GIBIBYTE = 1 << 30
LIMITS = Limits(cpu_s=2 * 3600, wall_s=4 * 3600, memory_bytes=GIBIBYTE, output_bytes=4 * GIBIBYTE)
MOST_KEPT_BYTES = 2 * GIBIBYTE
REFUSED, NO_MEMORY, NO_ROOM = 2, 3, 4
"""Exit statuses: faults are in ``found.json``; the memory limit was met; the disk is full."""
