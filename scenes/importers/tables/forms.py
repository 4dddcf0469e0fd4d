"""The forms of tables of markers, as importers: each file of this folder reads one, all become scenes the same way."""

from __future__ import annotations

from collections.abc import Callable

from physworld.scene import Scene
from physworld_scenes.importers import c3d
from physworld_scenes.importers.axes import ROTATION_FROM_UP
from physworld_scenes.importers.options import Importer, ImportOptions, Looked
from physworld_scenes.importers.tables import arrays, logs, motive, plain, qualisys, trc, vicon
from physworld_scenes.importers.tables.hdf5_content import is_hdf5
from physworld_scenes.importers.tables.mcap_content import is_mcap
from physworld_scenes.importers.tables.scene import TableReader, reading_of, scene_of

Recognise = Callable[[bytes, str], bool]


def form(
    name: str,
    title: str,
    suffixes: tuple[str, ...],
    help: str,
    recognises: Recognise,
    read_table: TableReader,
) -> Importer:
    """An importer of one form: its ``read_table``, then what all share.

    Args:
        name: as on the wire.
        title: for people.
        suffixes: of its files, with the dot.
        help: one line for lists of importers.
        recognises: whether a file is of this form, by its beginning.
        read_table: a file to its markers.
    """

    def read(data: bytes, scene_name: str, options: ImportOptions | None) -> tuple[Scene, list[str]]:
        given = options or ImportOptions()
        return scene_of(reading_of(read_table(data, name), name, given), name, scene_name, given)

    def look(data: bytes, scene_name: str, options: ImportOptions | None) -> Looked:
        found = reading_of(read_table(data, name), name, options or ImportOptions())
        guesses = tuple((g.what, g.value, g.how, g.option) for g in found.guesses)
        axes = tuple(tuple(axis) for axis in ROTATION_FROM_UP[found.up].T.tolist())
        return Looked(guesses, (*found.lines, *found.warnings), found.markers, axes)

    return Importer(name, title, suffixes, help, recognises, read, look)


NPZ = form(
    "npz",
    "npz of tracks",
    (".npz",),
    "an array (frames, markers, 3), times or rate, names, what is seen; two arrays are two groups",
    arrays.is_npz,
    arrays.read_table,
)
"""Before bundles, which are zips too."""
FORMS = (
    form(
        "c3d",
        "C3D motion capture",
        (".c3d",),
        "markers, in metres by POINT:UNITS; gaps are not visible; controllers by names, rigidity or options",
        c3d.is_c3d,
        c3d.read_table,
    ),
    form(
        "motive",
        motive.FORM,
        (".csv",),
        "markers and rigid bodies of format versions 1.1 to 1.25; poses by quaternions",
        motive.is_motive,
        motive.read_table,
    ),
    form(
        "vicon",
        vicon.FORM,
        (".csv",),
        "the section Trajectories; others are left out",
        vicon.is_vicon,
        vicon.read_table,
    ),
    form(
        "qualisys",
        qualisys.FORM,
        (".tsv", ".txt"),
        "3D data with header, with or without heads of columns, frame and time",
        qualisys.is_qualisys,
        qualisys.read_table,
    ),
    form(
        "trc",
        "TRC of OpenSim or Motive",
        (".trc",),
        "markers in the unit that it says",
        trc.is_trc,
        trc.read_table,
    ),
    form(
        "hdf5",
        "HDF5 of tracks",
        (".h5", ".hdf5"),
        "datasets as those of an npz; needs the extra tables",
        is_hdf5,
        logs.read_hdf5,
    ),
    form(
        "mcap",
        "MCAP log",
        (".mcap",),
        "poses and points, JSON or ROS 2, each topic a marker or a group; needs the extra tables",
        is_mcap,
        logs.read_mcap,
    ),
)
PLAIN = form(
    "columns",
    "plain columns of numbers",
    (".csv", ".tsv", ".txt"),
    "a time, and x, y and z of every marker by the names of the columns; one row a frame, or one a marker and frame",
    plain.is_plain,
    plain.read_table,
)
"""The last one: any text may be columns."""
