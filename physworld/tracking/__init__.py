"""From pictures with depth to tracks: the object's mask, points that are followed, grips, the cloud of the first frame.

All classical and on a CPU: OpenCV's flow, GrabCut and markers, patches of the first frame, rigid neighbours. Arrays in,
arrays out: files are the business of ``physworld_scenes.importers``. A camera's convention is that of
:mod:`physworld.camera`; the world is z up, metres.
"""
