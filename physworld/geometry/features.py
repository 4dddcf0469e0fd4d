"""Part features of particles: where two particles belong to the same part, their features are close.

Supplied features (PartField's, say) are carried to the particles by nearest neighbour. Without any, a
spectral embedding of the geometry serves: the first k non-trivial eigenvectors φ_j of the Laplacian
L = D - W of a nearest-neighbour graph, each divided by the root of its eigenvalue, ψ_ij = φ_ij/√λ_j, so
that |ψ_i - ψ_l|² is the commute time between i and l cut after k terms (Qiu & Hancock 2007). Limbs joined by
a thin neck are far apart in it, and points across a thick part are near, which plain distance does not see.

Both are scaled so that the root-mean-square distance between two particles is 1: the length scale of the
property field is then a pure number. Features are continuous along the body and blind to rigid motion.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.sparse.linalg import eigsh
from scipy.spatial import cKDTree

from physworld.arrays import Array

DENSE_LIMIT = 400  # up to here a dense eigenproblem is faster than Lanczos, and exact
START_SEED = 20250901  # Lanczos' start vector: the embedding is a pure function of its points


def part_features(points: Array, k: int = 8, *, neighbors: int = 12) -> Array:
    """Spectral part features of ``points`` [m] (P, 3): float64 (P, k), zero mean, unit RMS distance.

    Columns past the number of non-trivial eigenvectors (P - 1) are zero. Disconnected parts are joined by one
    bridge each, which the embedding sees as a thin neck.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or points.shape[0] < 1:
        raise ValueError(f"points of shape {points.shape}, expected (P, 3) with P ≥ 1")
    if k < 1:
        raise ValueError(f"{k} features asked for")
    count = points.shape[0]
    wanted = min(k, count - 1)
    features = np.zeros((count, k))
    if wanted < 1:
        return features
    laplacian = csgraph.laplacian(neighbor_graph(points, neighbors))
    values, vectors = _lowest_eigenpairs(laplacian, wanted + 1)
    values, vectors = values[1:], vectors[:, 1:]
    features[:, :wanted] = _with_fixed_signs(vectors) / np.sqrt(values)
    return standardise(features)


def carry_features(sources: Array, features: Array, targets: Array) -> Array:
    """Features (S, F) of ``sources`` (S, 3) at ``targets`` (P, 3) by nearest neighbour; standardised."""
    sources, features = np.asarray(sources, dtype=np.float64), np.asarray(features, dtype=np.float64)
    if features.ndim != 2 or features.shape[0] != sources.shape[0]:
        raise ValueError(f"features of shape {features.shape} do not belong to {sources.shape[0]} points")
    if not np.isfinite(features).all():
        raise ValueError(f"{int((~np.isfinite(features)).sum())} part features are not finite")
    _, nearest = cKDTree(sources).query(targets)
    return standardise(features[nearest])


def standardise(features: Array) -> Array:
    """Features (P, F) with zero mean, scaled so that two random particles are at RMS distance 1."""
    centred = features - features.mean(axis=0)
    # E|F_i - F_j|² = 2·E|F_i - mean|²
    scale = float(np.sqrt(2.0 * np.mean(np.sum(centred**2, axis=1))))
    scaled: Array = centred / scale if scale > 0.0 else centred
    return scaled


def neighbor_graph(points: Array, neighbors: int) -> sparse.csr_matrix:
    """Symmetric connected graph of ``points`` (P, 3), weights exp(-d²/2h²), h the mean neighbour distance.

    Every point is joined to its ``neighbors`` nearest; parts that stay apart get one bridge of unit weight
    between their nearest points.
    """
    count = points.shape[0]
    distances, indices = cKDTree(points).query(points, k=min(neighbors, count - 1) + 1)
    distances, indices = np.atleast_2d(distances)[:, 1:], np.atleast_2d(indices)[:, 1:]
    scale = max(float(distances.mean()), np.finfo(np.float64).tiny)
    rows = np.repeat(np.arange(count), distances.shape[1])
    weights = np.exp(-0.5 * (distances.ravel() / scale) ** 2).clip(1e-6)
    graph = sparse.coo_matrix((weights, (rows, indices.ravel())), shape=(count, count)).tocsr()
    graph = graph.maximum(graph.T)
    bridges = _bridges(points, graph)
    if len(bridges):
        ones = np.ones(len(bridges))
        extra = sparse.coo_matrix((ones, (bridges[:, 0], bridges[:, 1])), shape=(count, count)).tocsr()
        graph = graph.maximum(extra).maximum(extra.T)
    graph.setdiag(0.0)
    graph.eliminate_zeros()
    return graph


def _bridges(points: Array, graph: sparse.csr_matrix) -> Array:
    """Pairs (B, 2) of points that join the graph's components into one, nearest component first."""
    parts, labels = csgraph.connected_components(graph, directed=False)
    pairs = []
    joined = labels == labels[0]
    while parts > 1 and not joined.all():
        inside, outside = np.flatnonzero(joined), np.flatnonzero(~joined)
        distances, nearest = cKDTree(points[inside]).query(points[outside])
        best = int(np.argmin(distances))
        pairs.append((inside[nearest[best]], outside[best]))
        joined |= labels == labels[outside[best]]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _lowest_eigenpairs(laplacian: sparse.csr_matrix, count: int) -> tuple[Array, Array]:
    """The ``count`` smallest eigenvalues, ascending, and their unit eigenvectors (P, count)."""
    size = laplacian.shape[0]
    if size <= max(DENSE_LIMIT, 3 * count):
        values, vectors = np.linalg.eigh(laplacian.toarray())
        return values[:count], vectors[:, :count]
    start = np.random.default_rng(START_SEED).standard_normal(size)
    # a shift just below zero keeps the factorised matrix regular without moving the eigenvectors
    shift = -1e-6 * float(laplacian.diagonal().mean())
    values, vectors = eigsh(laplacian.tocsc(), k=count, sigma=shift, which="LM", v0=start)
    order = np.argsort(values)
    return values[order], vectors[:, order]


def _with_fixed_signs(vectors: Array) -> Array:
    """Eigenvectors whose largest component is positive, so that equal inputs give equal features."""
    largest = np.abs(vectors).argmax(axis=0)
    signs = np.sign(vectors[largest, np.arange(vectors.shape[1])])
    return vectors * np.where(signs == 0.0, 1.0, signs)
