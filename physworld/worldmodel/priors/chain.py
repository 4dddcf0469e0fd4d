"""The chain prior of ropes: point masses along the centre line, pulled and bent, driven where the grips hold them.

A rope that swings turns by more than any linear map of places can follow (``modal``). Its twin is a curve whose rest
places lie on a line, and its vertices lie on that curve: they are written in K nodes along it,

    q = read · x + hold · q_driven         x = spread · q       (spread: natural cubic spline through the nodes)
    q_driven = c̄_g + R_g · offset          of what grip g holds; c̄_g mean, R_g frame of its control vertices

and the nodes are moved through one tick by S substeps of the semi-implicit Euler method, times in ticks:

    pulled_j = q_{j+1} - q_j,   bent_i = curve_i · q                       segments j, inner nodes i
    tension_j = pull_j (1 - length_j / |pulled_j|) + dash_j d|pulled_j|/dt / |pulled_j|
    v̇_k = ease_k (tension_k pulled_k - tension_{k-1} pulled_{k-1} - curveᵀ (bend · (bent - bent°)))_k + gravity
    v   = calm · v                            CALMINGS times a tick: internal friction of bending, implicitly

A step sees places, no speeds, and must neither damp nor excite what moves freely over hundreds of ticks. So the flow is
taken twice, from the places now with the speed that the last frames show, and with its opposite (the grips' path
backwards). Their mean is what does not depend on the speed but through its square, and

    E = ½ (flow(q^t, v) + flow(q^t, -v)),     q^{t+1} = E + keep · rigid(E - q^{t-1})

is exact for whatever oscillates: q^{t+1} + q^{t-1} = 2 E without losses. ``keep`` holds the losses of a tick: air drag,
the friction of bending, and a little of the shortest waves. ``rigid`` takes out what stretches segments: stretch waves
run through the rope many times within a tick, so that they follow the load at once.

A cable that was coiled is not straight when nothing acts. Its natural curvature is fixed in its cross sections, whose
directions d_j are carried along the rope by the least rotations from one segment's tangent t_j to the next one's
(Bishop, Amer. Math. Monthly 82, 1975), and are turned evenly between two grips (twist is quasi-static, as in Bergou et
al. 2008):

    d_a = R_g normal_0, made normal to t_a      a, g = carry_0: the first segment beside a grip, and that grip
    θ   = angle about t_b from d_b to R_g' normal_1, less ``twist``, in (-π, π]       b, g' = carry_1, the last one
    d_j is turned about t_j by between_j θ;  d'_j = t_j × d_j;  bent°_i = natural_i1 d̄_i + natural_i2 d̄'_i

with the means d̄ of the two segments at a joint. bent° is taken at q^t and stays through the tick, of which E keeps no
error of first order either. With one end only, carry_1 = carry_0 and between = 0.

Φ scales what it stands for, node by node: pull and bend by exp(log E/E_fit), masses by exp(log ρ/ρ_fit), both within
``reach``, for which the substeps are short enough. Ground, contact and twist waves are not represented.

Legend: n object vertices, C control vertices, G grips, K nodes; masses per mass density, so that pull and bend are per
density too. Positions in metres, world axes. NumPy only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import expm

from physworld.arrays import Array
from physworld.worldmodel.priors.chain_layout import ChainLayout

CALMINGS = 8
FEWEST_NODES = 3
MOST_SUBSTEPS = 96
STABILITY = 1.2  # the substep is that much below the stability limit
STRETCH_DAMPING = 0.3  # of critical, of a stretch wave as long as two segments
SHORT_LOSS, SHORT_ORDER = (
    0.3,
    4,
)  # log loss of waves that turn by 2 rad a tick; it grows with that power of the square
STRAIGHTENED = 0.05  # share of the mean diagonal that keeps ``slack`` regular between two grips


@dataclass(frozen=True)
class ChainPhysics:
    """What a chain is made of, per mass density.

    Attributes:
        wave_m_s: speed of stretch waves.
        bending_m4_s2: bending stiffness.
        friction_s: Kelvin-Voigt time of bending.
        drag_per_s: linear drag.
        gravity_m_s2: (3,).
    """

    wave_m_s: float
    bending_m4_s2: float
    friction_s: float
    drag_per_s: float
    gravity_m_s2: Array


@dataclass(frozen=True)
class ChainPrior:
    """The arrays of the module's text.

    Attributes:
        spread (n, K), read (K, n), hold (K, K): vertices of nodes and nodes of vertices.
        member (K, G), offset (K, 3): who holds a node, and where in its frame [m].
        anchor, first, second (G, C), axis (G, 3), markers (G,): the grips' frames (:mod:`chain_layout`).
        length (K-1,) [m], pull (K-1,), mass (K,) [m], curve (K-2, K), bend (K-2,), dash (K-1,): forces.
        keep, calm, smooth (K, K): losses of a tick, of a substep, and of the speed's shortest waves.
        slack (K-1, K-1): pushes along the segments that take a stretch of one of them back.
        natural (K-2, 2) [1/m], carry (2, 2), normal (2, 3), twist (1,) [rad], between (K-1,): the natural curvature.
        share (K, n): Φ of nodes from vertices; reach (2,): its largest sizes.
        gravity (3,) [m/tick²].
        substeps: S.
    """

    spread: Array
    read: Array
    hold: Array
    member: Array
    offset: Array
    anchor: Array
    first: Array
    second: Array
    axis: Array
    markers: Array
    length: Array
    pull: Array
    mass: Array
    curve: Array
    bend: Array
    dash: Array
    natural: Array
    carry: Array
    normal: Array
    twist: Array
    between: Array
    keep: Array
    calm: Array
    smooth: Array
    slack: Array
    share: Array
    reach: Array
    gravity: Array
    substeps: int

    def __post_init__(self) -> None:
        """The rollout engine reads these arrays by their sizes. Raises ValueError for others."""
        nodes, grips = len(self.mass), len(self.markers)
        vertices, controls = len(self.spread), [0, *self.anchor.shape][-1]
        if nodes < FEWEST_NODES:
            raise ValueError(f"a chain of {nodes} nodes; it has at least {FEWEST_NODES}")
        inner, segments, square = nodes - 2, nodes - 1, (nodes, nodes)
        expected = {
            "spread": (vertices, nodes),
            "read": (nodes, vertices),
            "member": (nodes, grips),
            "offset": (nodes, 3),
            "axis": (grips, 3),
            "markers": (grips,),
            "mass": (nodes,),
            "curve": (inner, nodes),
            "bend": (inner,),
            "natural": (inner, 2),
            "carry": (2, 2),
            "normal": (2, 3),
            "twist": (1,),
            "slack": (segments, segments),
            "share": (nodes, vertices),
            "reach": (2,),
            "gravity": (3,),
            **dict.fromkeys(("anchor", "first", "second"), (grips, controls)),
            **dict.fromkeys(("length", "pull", "dash", "between"), (segments,)),
            **dict.fromkeys(("hold", "keep", "calm", "smooth"), square),
        }
        found = {name: np.shape(getattr(self, name)) for name in expected}
        if wrong := [f"{name} {found[name]}" for name, shape in expected.items() if found[name] != shape]:
            raise ValueError(
                f"{nodes} nodes of {vertices} vertices and {grips} grips, but the prior has {', '.join(wrong)}"
            )
        ends = np.asarray(self.carry)
        if not ((ends >= 0) & (ends < [segments, grips])).all():
            raise ValueError(f"ends {ends.tolist()} of a chain of {segments} segments and {grips} grips")
        if self.substeps < 1 or self.substeps % CALMINGS:
            raise ValueError(f"{self.substeps} substeps; there are {CALMINGS} or a multiple of them")


def straight(nodes: int) -> dict[str, Array]:
    """The fields of the natural curvature of a chain that has none."""
    return {
        "natural": np.zeros((nodes - 2, 2), np.float32),
        "carry": np.zeros((2, 2), np.float32),
        "normal": np.zeros((2, 3), np.float32),
        "twist": np.zeros(1, np.float32),
        "between": np.zeros(nodes - 1, np.float32),
    }


def chain_of(layout: ChainLayout, physics: ChainPhysics, dt_s: float, reach: Array) -> ChainPrior:
    """The prior of a layout and its physics; the wave speed is lowered to what ``MOST_SUBSTEPS`` can carry.

    Args:
        layout: nodes along the body, and how vertices hang on them.
        physics: wave speed, bending, losses and gravity.
        dt_s: of the model's clock [s].
        reach: largest |log ratio| of stiffness and of density that it has to stay stable at (2,).
    """
    length = np.diff(layout.nodes)
    count, free = len(layout.nodes), layout.member.sum(axis=1) == 0
    mass = 0.5 * (np.append(length, 0.0) + np.append(0.0, length))
    width = 0.5 * (length[1:] + length[:-1])
    curve = np.zeros((count - 2, count))
    rows = np.arange(count - 2)
    curve[rows, rows], curve[rows, rows + 2] = 1.0 / (length[:-1] * width), 1.0 / (length[1:] * width)
    curve[rows, rows + 1] = -curve[rows, rows] - curve[rows, rows + 2]
    differ = np.diff(np.eye(count), axis=0)
    bending = (curve.T * width) @ curve
    wave, stiff = physics.wave_m_s, physics.bending_m4_s2
    while (
        substeps := _substeps(differ, length, mass, bending, free, wave, stiff, dt_s, reach)
    ) > MOST_SUBSTEPS:
        wave, stiff = 0.93 * wave, stiff if wave > 5.0 else 0.93 * stiff
    rate = np.where(free[:, None], stiff * bending / mass[:, None], 0.0)  # squared angular frequencies
    losses = physics.friction_s * rate + physics.drag_per_s * np.diag(free.astype(float))
    taut = float(np.linalg.norm(physics.gravity_m_s2) * (layout.nodes[-1] - layout.nodes[0]))
    short = _short_waves(stiff * bending + taut * (differ.T / length) @ differ, mass, free, dt_s)
    tie = (differ * (free / mass)) @ differ.T
    prior = ChainPrior(
        spread=layout.spread,
        read=layout.read,
        hold=layout.hold,
        member=layout.member,
        offset=layout.offset,
        anchor=layout.grips.anchor,
        first=layout.grips.first,
        second=layout.grips.second,
        axis=layout.grips.axis,
        markers=layout.grips.markers,
        length=length,
        pull=(wave * dt_s) ** 2 / length,
        mass=mass,
        curve=curve,
        bend=stiff * dt_s**2 * width,
        dash=np.full(count - 1, STRETCH_DAMPING * wave * dt_s),
        natural=np.zeros((count - 2, 2)),
        carry=layout.carry,
        normal=layout.normal,
        twist=np.zeros(1),
        between=layout.between,
        keep=short @ expm(-dt_s * losses),
        calm=np.linalg.inv(np.eye(count) + dt_s / CALMINGS * physics.friction_s * rate),
        smooth=short,
        slack=np.linalg.inv(tie + STRAIGHTENED * np.trace(tie) / count * np.eye(count - 1)),
        share=layout.share,
        reach=np.asarray(reach, dtype=float),
        gravity=physics.gravity_m_s2 * dt_s**2,
        substeps=substeps,
    )
    single: dict[str, Any] = {name: np.float32(v) for name, v in vars(prior).items() if name != "substeps"}
    return replace(prior, **single)


def _short_waves(stiffness: Array, mass: Array, free: Array, dt_s: float) -> Array:
    """What a tick leaves of each wave, (K, K): all of the long ones, nothing of those that turn by π and more.

    They are told apart by the squared angular frequencies of bending and of a rope under its own weight.
    """
    root = np.sqrt(mass[free])
    squares, waves = np.linalg.eigh(stiffness[np.ix_(free, free)] / (root * root[:, None]))
    left = np.exp(
        -SHORT_LOSS * np.minimum(np.clip(squares, 0.0, None) * (0.5 * dt_s) ** 2, 10.0) ** SHORT_ORDER
    )
    kept = np.eye(len(mass))
    moving, resting = np.ix_(free, free), np.ix_(free, ~free)
    kept[moving] = (waves * left) @ waves.T * root / root[:, None]
    by_rest = (waves * ((left - 1.0) / np.maximum(squares, 1e-12))) @ waves.T * root / root[:, None]
    kept[resting] = by_rest @ (stiffness[resting] / mass[free, None])
    return kept


def _substeps(
    differ: Array,
    length: Array,
    mass: Array,
    bending: Array,
    free: Array,
    wave: float,
    stiff: float,
    dt_s: float,
    reach: Array,
) -> int:
    """Substeps of a tick for which the fastest wave is stable at the stiffest and lightest that ``reach`` allows."""
    whole = wave**2 * (differ.T / length) @ differ + stiff * bending
    scaled = (whole / np.sqrt(mass * mass[:, None]))[np.ix_(free, free)]
    fastest = np.sqrt(max(np.linalg.eigvalsh(scaled).max(), 0.0) * np.exp(reach.sum()))
    return int(max(1, np.ceil(0.5 * STABILITY * dt_s * fastest / CALMINGS))) * CALMINGS
