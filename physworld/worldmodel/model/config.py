"""Settings of the graph network and of its training (paper, section GNN-Based World Models)."""

from __future__ import annotations

from dataclasses import dataclass

PRIORS = ("auto", "modal", "chain", "none")
NEAR_EDGES = ("material", "current")
FRAMES = ("auto", "world", "grip")


@dataclass(frozen=True)
class WorldModelConfig:
    """Architecture and graph.

    Attributes:
        hidden: width of every latent vector.
        message_passing_steps: steps with unshared weights; 7 in the paper.
        history: h; the network sees h + 1 frames, h velocities.
        vertices: object vertices by farthest-point sampling, 100 to 150 in the paper.
        neighbours: each vertex hears at least its so many nearest; the edge set is made symmetric, so the
            mean degree comes out about a fifth higher.
        near_edges: "material": those nearest at rest, kept; "current": the ``neighbours`` nearest within the edge
            radius at every step, so that parts that meet see each other (``physworld.worldmodel.model.nearest``).
        edge_radius_spacings: no edge between object vertices is longer than this many vertex spacings d_v.
        coarse_vertices: so many vertices, spread over the body, are linked with each other.
        coarse_links: and every vertex with so many of them; 0 leaves the paper's local graph.
        modes: most modes of the modal prior.
        control_vertices_all, control_vertices_per_grip: with more than ``control_vertices_all``
            controllers, so many of each rigid group become vertices.
    """

    hidden: int = 48
    message_passing_steps: int = 3
    history: int = 3
    vertices: int = 100
    neighbours: int = 10
    near_edges: str = "material"
    edge_radius_spacings: float = 6.0
    coarse_vertices: int = 12
    coarse_links: int = 2
    modes: int = 48
    control_vertices_all: int = 16
    control_vertices_per_grip: int = 6

    def __post_init__(self) -> None:
        for name in ("hidden", "message_passing_steps", "history", "vertices", "neighbours"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, but must be at least 1")
        if self.near_edges not in NEAR_EDGES:
            raise ValueError(f"near_edges {self.near_edges!r}; known are {', '.join(NEAR_EDGES)}")


@dataclass(frozen=True)
class TrainingConfig:
    """Training of one model on the episodes of one dataset.

    Attributes:
        steps: optimiser steps.
        batch_size: sub-sequences a step.
        look_ahead: τ, the steps that a sub-sequence is unrolled for the loss.
        learning_rate: Adam's, decayed by a cosine to ``learning_rate_floor`` of itself.
        gradient_clip: largest norm of the gradient.
        noise_history: standard deviation of the last velocity of the random walk on the history, in units of what the
            prior leaves of a step (σ_change); it teaches the network to pull errors back.
        noise_properties: standard deviation of the noise on Φ, in units of the data's spread of Φ.
        average_decay: decay of the running average of the weights that is validated and published.
        validation_fraction: share of the episodes held out whole.
        validation_every: steps between open-loop validations.
        patience: validations in a row without a better one after which the training ends early; 0: never.
        prior: what stands under the network: "modal", "chain", "auto": of the two the one whose network errs less on
            validation episodes after the first steps, or "none": the network alone gives the accelerations
            (``physworld.worldmodel.model.inertia``).
        frame: in which axes a step is taken: "world"; "grip": in the grip's frame where the scene has one
            (``physworld.worldmodel.model.frame``); "auto": what errs less on validation episodes.
        start_share: share of the episodes that the training begins with; 1: it has all of them from the start.
        checkpoint_every: steps between checkpoints.
        threads: torch threads.
        seed: of initial weights, batches and noise.
    """

    steps: int = 1200
    batch_size: int = 6
    look_ahead: int = 24
    learning_rate: float = 1e-3
    learning_rate_floor: float = 0.01
    gradient_clip: float = 1.0
    noise_history: float = 0.02
    noise_properties: float = 0.05
    average_decay: float = 0.99
    validation_fraction: float = 0.1
    validation_every: int = 250
    patience: int = 0
    prior: str = "auto"
    frame: str = "auto"
    start_share: float = 1.0
    checkpoint_every: int = 250
    threads: int = 1
    seed: int = 0

    def __post_init__(self) -> None:
        if self.patience < 0 or not 0.0 < self.start_share <= 1.0:
            raise ValueError(
                f"patience {self.patience}, start share {self.start_share:g} (above 0, at most 1)"
            )
        if self.prior not in PRIORS:
            raise ValueError(f"prior {self.prior!r}; known are {', '.join(PRIORS)}")
        if self.frame not in FRAMES:
            raise ValueError(f"frame {self.frame!r}; known are {', '.join(FRAMES)}")


@dataclass(frozen=True)
class FineTuneConfig:
    """Optimisation of Φ per vertex on the recording, weights frozen.

    Attributes:
        steps: optimiser steps; 0 leaves Φ as calibrated.
        window: model steps of one open-loop segment.
        windows: segments spread over the fitting frames.
        learning_rate: Adam's, in units of the training data's spread of Φ.
        chamfer_weight: weight of the one-way Chamfer term beside the mean squared error.
        smoothness_weight: pull of Φ towards its value at start, per unit of the data's spread squared.
        validation_fraction: last share of the training frames that only decides when to stop.
    """

    steps: int = 60
    window: int = 24
    windows: int = 4
    learning_rate: float = 0.05
    chamfer_weight: float = 0.1
    smoothness_weight: float = 1e-3
    validation_fraction: float = 0.25
