"""Recordings of sheets by an engine that is not ours: MuJoCo flex, linear triangles whose edges bend like hinges.

A sheet hangs by two corners that move. Cells have alternate diagonals and vertices their share of the area's mass, as a
mesh of triangles should. No damping, no contact.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import NDArray

from physworld.scene import UNDEFORMED_AT_REST, Body, Grip, Scene

Floats = NDArray[np.float64]

FPS, TRAIN_SHARE = 30.0, 0.7
GRAVITY = (0.0, 0.0, -9.81)
_TOP_M = 0.6
_HELD_CELLS = 2  # of the coarsest mesh, along either edge of a held corner
_TRACKED = 300


@dataclass(frozen=True)
class FlexSheet:
    """A sheet of ``cells`` times ``subdivision`` cells.

    Attributes:
        size_m: width and height.
        seed: of the motion, the places of the points and the noise.
    """

    size_m: tuple[float, float] = (0.24, 0.26)
    cells: tuple[int, int] = (16, 15)
    subdivision: int = 1
    young_pa: float = 1.8e5
    poisson: float = 0.3
    thickness_m: float = 0.005
    density_kg_m3: float = 380.0
    noise_sigma_m: float = 1e-3
    frames: int = 70
    steps_per_frame: int = 340  # for one subdivision
    seed: int = 0
    counts: tuple[int, int] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "counts", tuple(self.subdivision * n for n in self.cells))

    @property
    def steps(self) -> int:
        """Time steps a frame."""
        return self.steps_per_frame * self.subdivision

    def vertices(self) -> Floats:
        """At rest (V, 3) [m], in the plane y = 0, the top edge at the height of the grips."""
        x = np.linspace(-0.5, 0.5, self.counts[0] + 1) * self.size_m[0]
        z = _TOP_M - np.linspace(1.0, 0.0, self.counts[1] + 1) * self.size_m[1]
        across, up = np.meshgrid(x, z, indexing="ij")
        return np.stack([across.ravel(), np.zeros(across.size), up.ravel()], axis=1)

    def triangles(self) -> NDArray[np.int64]:
        """Vertices of the triangles (E, 3)."""
        rows = self.counts[1] + 1
        found = []
        for i, j in np.ndindex(*self.counts):
            a, b, c, d = i * rows + j, (i + 1) * rows + j, (i + 1) * rows + j + 1, i * rows + j + 1
            found += [(a, b, c), (a, c, d)] if (i + j) % 2 == 0 else [(a, b, d), (b, c, d)]
        return np.array(found)

    def masses(self) -> Floats:
        """Of the vertices (V,) [kg]: what a quarter of every cell at them weighs."""
        share = [np.r_[0.5, np.ones(n - 1), 0.5] / n for n in self.counts]
        total = self.density_kg_m3 * self.thickness_m * self.size_m[0] * self.size_m[1]
        return total * np.outer(*share).ravel()

    def corners(self) -> tuple[Floats, Floats]:
        """The boxes that the two grips hold at rest (2, 3) [m]."""
        width, height = (_HELD_CELLS * s / n for s, n in zip(self.size_m, self.cells, strict=True))
        half = 0.5 * self.size_m[0]
        boxes = (-half, -half + width), (half - width, half)
        low, high = -0.5 * self.thickness_m, 0.5 * self.thickness_m
        return tuple(  # type: ignore[return-value]
            np.array([[begin, low, _TOP_M - height], [end, high, _TOP_M]]) for begin, end in boxes
        )

    def model(self) -> mujoco.MjModel:
        """The sheet as MuJoCo has it."""
        numbers = " ".join(f"{value:.9g}" for value in self.vertices().ravel())
        elements = " ".join(str(number) for number in self.triangles().ravel())
        model = mujoco.MjModel.from_xml_string(
            f"""<mujoco><option timestep="{1.0 / FPS / self.steps}" solver="CG" iterations="1"
            gravity="{" ".join(map(str, GRAVITY))}"><flag contact="disable"/></option><worldbody><body name="frame">
            <flexcomp name="sheet" type="direct" dim="2" mass="1" radius="{0.5 * self.thickness_m}" point="{numbers}"
            element="{elements}"><edge equality="false" damping="0"/><contact selfcollide="none" contype="0"
            conaffinity="0"/><elasticity young="{self.young_pa}" poisson="{self.poisson}" damping="0"
            thickness="{self.thickness_m}" elastic2d="both"/></flexcomp></body></worldbody></mujoco>"""
        )
        model.body_mass[model.flex_vertbodyid] = self.masses()
        mujoco.mj_setConst(model, mujoco.MjData(model))
        return model


def bending_stiffnesses(sheet: FlexSheet) -> dict[str, float]:
    """What the mesh stores in a cylinder along either axis and in a twist, over what an isotropic plate does.

    The vertices lie on the surface but for offsets that alternate from vertex to vertex or from row to row, which
    settle where they cost least: with alternate diagonals even and odd vertices have different hinges.
    """
    model = sheet.model()
    rest = sheet.vertices()
    x, _, z = (rest - rest.mean(axis=0)).T
    plate = sheet.young_pa * sheet.thickness_m**3 / 12.0 / (1.0 - sheet.poisson**2)
    area = float(np.prod(sheet.size_m))
    shapes = {"warp": 0.5 * x**2, "weft": 0.5 * z**2, "twist": x * z}
    expected = {"warp": 0.5, "weft": 0.5, "twist": 1.0 - sheet.poisson}
    i, j = (number.ravel() for number in np.indices((sheet.counts[0] + 1, sheet.counts[1] + 1)))
    inside = (i > 0) & (i < sheet.counts[0]) & (j > 0) & (j < sheet.counts[1])
    offsets = np.stack([(-1.0) ** (i + j), (-1.0) ** i, (-1.0) ** j]) * inside

    def pulls(heights: Floats) -> Floats:
        """Restoring forces (V,) [N/m] along the normal, of unit heights (V,)."""
        small = 1e-5  # m: small enough for the membrane to stay still
        data = mujoco.MjData(model)
        moved = np.zeros_like(rest)
        moved[:, 1] = small * heights
        data.qpos[:] = moved.ravel()
        mujoco.mj_forward(model, data)
        return -data.qfrc_spring.reshape(-1, 3)[:, 1] / small

    stiffness = np.stack([pulls(offset) for offset in offsets]) @ offsets.T
    found = {}
    for name, shape in shapes.items():
        force = pulls(shape)
        relaxed = offsets @ force
        stored = 0.5 * float(shape @ force - relaxed @ np.linalg.solve(stiffness, relaxed))
        found[name] = stored / (expected[name] * plate * area)
    return found


class _Motion:
    """Ways of the two corners from rest: each swings along a line of its own, at its own pace."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.line = rng.uniform((0.0, 0.015, 0.005), (0.01, 0.03, 0.02), (2, 3)) * rng.choice(
            [-1.0, 1.0], (2, 3)
        )
        self.pace = rng.uniform(5.0, 9.0, (2, 1))  # rad/s

    def shifts(self, t: float) -> Floats:
        """Of the two grips [m], (2, 3)."""
        since = max(t, 0.0)
        return (1.0 - np.exp(-((since / 0.1) ** 2))) * self.line * np.sin(self.pace * since)


def record(sheet: FlexSheet) -> Scene:
    """Simulate the sheet and track it with noise.

    Returns:
        A scene of kind "sheet", at 30 Hz, 300 tracked points, with 3 x 3 control points a grip.
    """
    rng = np.random.default_rng(sheet.seed + 1)
    motion = _Motion(sheet.seed)
    rest = sheet.vertices()
    boxes = sheet.corners()
    held = [
        np.flatnonzero(np.all((rest >= box[0] - 1e-9) & (rest <= box[1] + 1e-9), axis=1)) for box in boxes
    ]
    nodes = _simulate(sheet, motion, held)
    places = rng.uniform(0.0, 1.0, (_TRACKED, 2))
    clean = _interpolated(sheet, nodes, places)
    handles = [np.array([[x, 0.0, z] for x in np.linspace(*box[:, 0], 3) for z in np.linspace(*box[:, 2], 3)])
               for box in boxes]  # fmt: skip
    times = np.arange(sheet.frames) / FPS
    paths = np.stack([motion.shifts(t) for t in times])
    controllers = np.concatenate([h[None] + paths[:, g, None] for g, h in enumerate(handles)], axis=1)
    step = 1e-5
    rates = np.stack([(motion.shifts(t + step) - motion.shifts(t - step)) / (2.0 * step) for t in times])
    velocities = np.repeat(rates, 9, axis=1)
    seen = round(TRAIN_SHARE * sheet.frames)
    size = np.array([sheet.size_m[0], sheet.thickness_m, sheet.size_m[1]])
    grips = tuple(
        Grip(tuple(range(9 * g, 9 * g + 9)), box[0], box[1], tuple(np.flatnonzero(_inside(clean[0], box)).tolist()))
        for g, box in enumerate(boxes)
    )  # fmt: skip
    return Scene(
        name=f"flex_sheet_{sheet.seed}",
        kind="sheet",
        description="A sheet that hangs by two moving corners (MuJoCo flex).",
        points=clean + rng.normal(0.0, sheet.noise_sigma_m, clean.shape),
        visible=np.ones(clean.shape[:2], dtype=bool),
        controllers=controllers,
        controller_velocities=velocities,
        times=times,
        rest_volume_points=None,
        gravity_m_s2=np.array(GRAVITY),
        noise_sigma_m=sheet.noise_sigma_m,
        train=(0, seen),
        test=(seen, sheet.frames),
        initial_state=UNDEFORMED_AT_REST,
        fps=FPS,
        body=Body(
            size_m=size,
            thickness_m=sheet.thickness_m,
            density_kg_m3=sheet.density_kg_m3,
        ),
        grips=grips,
        declared={},
    )


def _simulate(sheet: FlexSheet, motion: _Motion, held: list[NDArray[np.int64]]) -> Floats:
    """Vertices of every frame (T, V, 3) [m]."""
    model, rest = sheet.model(), sheet.vertices()
    data = mujoco.MjData(model)
    step = model.opt.timestep
    rows = [(3 * nodes[:, None] + np.arange(3)).ravel() for nodes in held]
    frames = [rest.copy()]
    for count in range(1, (sheet.frames - 1) * sheet.steps + 1):
        mujoco.mj_step(model, data)
        now, before = motion.shifts(count * step), motion.shifts((count - 1) * step)
        for g, row in enumerate(rows):
            data.qpos[row] = np.tile(now[g], len(row) // 3)
            data.qvel[row] = np.tile((now[g] - before[g]) / step, len(row) // 3)
        if count % sheet.steps == 0:
            frames.append(rest + data.qpos.reshape(-1, 3))
    return np.stack(frames)


def _interpolated(sheet: FlexSheet, nodes: Floats, places: Floats) -> Floats:
    """Tracks (T, N, 3) [m] of points at ``places`` (N, 2) between 0 and 1 of the sheet, bilinear in its cells."""
    local = places * sheet.counts
    cell = np.minimum(local.astype(int), np.array(sheet.counts) - 1)
    u, v = (local - cell).T
    first = cell[:, 0] * (sheet.counts[1] + 1) + cell[:, 1]
    second = first + sheet.counts[1] + 1
    parts = ((first, (1 - u) * (1 - v)), (first + 1, (1 - u) * v), (second, u * (1 - v)), (second + 1, u * v))
    return sum(weight[None, :, None] * nodes[:, number] for number, weight in parts)  # type: ignore[return-value]


def _inside(points: Floats, box: Floats) -> NDArray[np.bool_]:
    return np.all((points >= box[0] - 1e-9) & (points <= box[1] + 1e-9), axis=1)
