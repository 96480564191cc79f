"""The covariance of a registered pose in numpy, which the C++ of ``avsreplay.register.covariance``
is compared with.

Also ``difference_covariance``: of the poses of two parts of one scan, for the tests of halves.
"""

from __future__ import annotations

from math import comb, factorial

import numpy as np
from numpy.typing import NDArray

from avsreplay.geometry import Array
from avsreplay.register.covariance import Evidence, Systematic

ALONE = 1e-9
BLOCK = 4
LEAST_HALF = 12
WORST_CONDITION = 1e8
OBSERVABLE = 1e-4
SIGNIFICANT = 4.0
LEAST_DETERMINED = 0.05
ROUNDS = 8
MODES = np.sqrt(2.0)
LENGTHS = (1.0, MODES, 2.0)
OBSERVABLE_RANGES = 3e-4
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def _unexplained(errors: Systematic, found: Evidence) -> Array:
    """The gradients (m, 6) without what pose and amplitudes explain."""
    return (
        found.gradients - found.normals @ errors.fit - _coupling(found, errors) @ errors.amplitudes
    )


def _error_of_one(A: Array) -> float:
    """Expected squared error of the entries of A, estimated with one degree of freedom."""
    return float(np.trace(A @ A) + np.trace(A) ** 2)


def sandwich_covariance(normals: Array, gradients: Array) -> tuple[Array, float]:
    """The bias-reduced sandwich covariance (6, 6), shrunk towards that of independent noise;
    its degrees of freedom.
    """
    values, vectors = np.linalg.eigh(normals.sum(axis=0))
    kept = values > len(values) * np.finfo(float).eps * values[-1]
    W = vectors[:, kept] / np.sqrt(values[kept])
    left, axes = np.linalg.eigh((1.0 + ALONE) * np.eye(W.shape[1]) - W.T @ normals @ W)
    along = np.einsum("pij,pi->pj", axes, gradients @ W) / np.sqrt(np.maximum(left, ALONE))
    y = np.einsum("pij,pj->pi", axes, along)
    S, rank = y.T @ y, W.shape[1]
    level = np.trace(S) / max(rank, 1)
    spread = np.sum((S - level * np.eye(rank)) ** 2)
    error = np.sum(np.sum(y**2, axis=1) ** 2) - np.sum(S**2) / len(y)
    intensity = np.clip(error / spread, 0.0, 1.0) if spread > 0.0 else 1.0
    shrunk = (1.0 - intensity) * S + intensity * level * np.eye(rank)
    trace_error = (np.sum(np.sum(y**2, axis=1) ** 2) - np.trace(S) ** 2 / len(y)) / rank
    left = trace_error + (1.0 - intensity) * max(error - trace_error, 0.0)
    return np.asarray(W @ shrunk @ W.T), float(np.clip(_error_of_one(shrunk) / left, 12.0, 1e6))


def systematic_errors(found: Evidence, extent_m: float, patch_m: float) -> Systematic:
    """Estimate the systematic errors of a scan from the structure of its residuals.

    Args:
        found: sums at the registered pose.
        extent_m: diagonal of the model's bounding box.
        patch_m: side of a patch.

    Returns:
        The variances; zero where every patch is a single point, or there are fewer than 24 patches.
    """
    zero = np.zeros(17)
    none = Systematic(extent_m, patch_m, 0.0, zero, zero, np.zeros(6), found.centre)
    if len(found.counts) < 2 * LEAST_HALF or found.counts.max() == 1:
        return none
    N, g, basis = _joined(found, none)
    inverse = _pseudo_inverse(N.sum(axis=0))
    fit = inverse @ g.sum(axis=0)
    variances, amplitudes = _range_errors(found, none, N, g - N @ fit, inverse, basis)
    g = g - _mode_columns(found, none, N, basis) @ amplitudes
    fit = inverse @ g.sum(axis=0)
    g = g - N @ fit
    leverage = np.trace(N @ inverse, axis1=1, axis2=2) / len(fit)
    S = g[:, :, None] * g[:, None, :] / np.maximum(1.0 - leverage, 0.5)[:, None, None]
    block, M = _block_variance(
        N, g, S, inverse, found.counts, _numbers(found.places, BLOCK * patch_m)
    )
    P = inverse @ (S.sum(axis=0) + block * M) @ inverse
    strains = slice(6, 6 + int(np.count_nonzero(basis[:6].any(axis=0))))
    strain = _common_variance(fit[strains], P[strains, strains])
    smooth = np.concatenate([np.full(7, strain), variances])
    smooth[6] = _common_variance(fit[strains.stop :], P[strains.stop :, strains.stop :])
    every = np.concatenate([basis @ fit[6:], amplitudes])
    return Systematic(extent_m, patch_m, block, smooth, every, fit[:6], found.centre)


def _range_errors(
    found: Evidence, none: Systematic, N: Array, left: Array, inverse: Array, basis: Array
) -> tuple[Array, Array]:
    """Variances and amplitudes (10,) of the modes of the ranges, by partitioned regression from
    what pose and amplitudes leave of the gradients (m, k).
    """
    D, X = _modes(found), _mode_columns(found, none, N, basis)
    B = X.sum(axis=0).T @ inverse
    own = np.einsum("pac,pab,pbd->pcd", D, found.normals[:, 3:, 3:], D)
    F = own.sum(axis=0) - B @ X.sum(axis=0)
    h = _mode_gradients(D, B, left)
    back, to = _combinations(F, np.ones(10), found)
    if not len(to):
        return np.zeros(10), np.zeros(10)
    moved = X @ (back @ to @ h.sum(axis=0))
    moved = moved - N @ (inverse @ moved.sum(axis=0))
    leverage = np.einsum("pcd,cd->p", own, back @ to) / len(to)
    r = _mode_gradients(D, B, left - moved)
    S = (r / np.maximum(1.0 - leverage, 0.5)[:, None]).T @ r
    degree = np.repeat(np.arange(4), np.arange(1, 5))
    variances, amplitudes, gains = [], [], []
    for length in LENGTHS:
        scale = (MODES / length) ** degree
        back, to = _combinations(F, scale, found)
        t, gain = _likely_variance(to @ h.sum(axis=0), to @ S @ to.T)
        variances.append(t * scale**2)
        amplitudes.append(back @ to @ h.sum(axis=0))
        gains.append(gain)
    likelihood = np.exp(0.5 * np.array(gains))
    if 2.0 * np.log(likelihood.mean()) <= SIGNIFICANT:
        return np.zeros(10), np.zeros(10)
    return likelihood @ variances / likelihood.sum(), amplitudes[int(np.argmax(gains))]


def _mode_gradients(D: Array, B: Array, g: Array) -> Array:
    """(m, 10): of each patch the part of its gradient by the modes that pose and amplitudes do
    not explain.
    """
    return np.asarray(np.einsum("pac,pa->pc", D, g[:, 3:6]) - g @ B.T)


def _combinations(F: Array, scale: Array, found: Evidence) -> tuple[Array, Array]:
    """The observable combinations of the modes times ``scale`` (10,): amplitudes of the modes
    from those along the combinations (10, n), and these from the summed gradients (n, 10).
    """
    values, vectors = np.linalg.eigh(F * np.outer(scale, scale))
    kept = values > OBSERVABLE_RANGES * found.counts.sum()
    back = scale[:, None] * vectors[:, kept]
    return back, (back / values[kept]).T


def _mode_columns(found: Evidence, none: Systematic, N: Array, basis: Array) -> Array:
    """(m, k, 10): sums over each patch of the derivatives by pose and amplitudes times those by
    each mode. The offset moves the surface along its normals, a mode along the rays.
    """
    D = _modes(found)
    of_surface = np.concatenate(
        [
            _strains(found, none).transpose(0, 2, 1) @ found.normals[:, 3:, 3:],
            found.offsets[:, None, 3:],
        ],
        axis=1,
    )
    return np.concatenate([found.normals[:, :, 3:] @ D, basis.T @ of_surface @ D], axis=1)


def _modes(found: Evidence) -> Array:
    """D (m, 3, 10): displacement of each patch per amplitude of a mode of the ranges."""
    if found.camera_c is None:
        return np.zeros((len(found.places), 3, 10))
    rays = found.places - found.camera_c
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    weight = found.counts / found.counts.sum()
    along = weight @ rays / np.linalg.norm(weight @ rays)
    first = np.eye(3)[np.argmin(np.abs(along))]
    first = first - (first @ along) * along
    first /= np.linalg.norm(first)
    across = np.stack([first, np.cross(along, first)])
    image = found.places @ across.T
    image = image - weight @ image
    u, v = (image / (MODES * np.sqrt(0.5 * weight @ np.sum(image**2, axis=1)))).T
    terms = [
        np.sqrt(comb(d, k) / (2**d * factorial(d))) * u ** (d - k) * v**k
        for d in range(4)
        for k in range(d + 1)
    ]
    return np.asarray(rays[:, :, None] * np.stack(terms, axis=1)[:, None, :])


def registration_covariance(found: Evidence, errors: Systematic) -> tuple[Array, float]:
    """Return the covariance (6, 6) of the registered pose, systematic errors included, and its
    degrees of freedom.

    Args:
        found: sums at the registered pose.
        errors: its systematic errors.
    """
    random, dof = sandwich_covariance(found.normals, _unexplained(errors, found))
    inverse = _pseudo_inverse(found.normals.sum(axis=0))
    X = inverse @ _summed(found.normals[:, :, 3:], _numbers(found.places, BLOCK * errors.patch_m))
    Y = inverse @ _coupling(found, errors).sum(axis=0)
    P = (
        random
        + errors.block_m2 * np.tensordot(X, X, ((0, 2), (0, 2)))
        + (errors.smooth_m2 * Y) @ Y.T
    )
    return np.asarray(0.5 * (P + P.T)), dof * max(
        42.0 / _error_of_one(np.linalg.solve(P, random)), 1.0
    )


def split_nis(found: Evidence, errors: Systematic, across: Array) -> float | None:
    """Return the larger normalised squared difference of the poses from two halves of the patches.

    Args:
        found: sums at the registered pose.
        errors: its systematic errors.
        across: (k, 3) directions in {C}: the patches are split at their medians along each.

    Returns:
        The largest over the directions, each chi-square with 6 degrees of freedom; None if a half
        does not determine a pose, or without directions.
    """
    if found.counts.max(initial=1) == 1 or not len(across):
        return None
    unexplained, coupling = _unexplained(errors, found), _coupling(found, errors)
    blocks = _numbers(found.places, BLOCK * errors.patch_m)
    values = []
    for along in across @ found.places.T:
        low = along < np.median(along)
        D, C = np.zeros(6), np.zeros((6, 6))
        X, Y = np.zeros((blocks.max() + 1, 6, 3)), np.zeros((6, 17))
        for half, sign in ((low, -1.0), (~low, 1.0)):
            normals = found.normals[half]
            inverse = _inverse(normals.sum(axis=0)) if len(normals) >= LEAST_HALF else None
            if inverse is None:
                return None
            D += sign * (inverse @ found.gradients[half].sum(axis=0))
            C += sandwich_covariance(normals, unexplained[half])[0]
            X += sign * (inverse @ _summed(normals[:, :, 3:], blocks[half], len(X)))
            Y += sign * (inverse @ coupling[half].sum(axis=0))
        C += errors.block_m2 * np.tensordot(X, X, ((0, 2), (0, 2))) + (errors.smooth_m2 * Y) @ Y.T
        values.append(float(D @ _pseudo_inverse(C) @ D))
    return max(values, default=None)


def difference_covariance(first: Evidence, second: Evidence, errors: Systematic) -> Array:
    """Return the covariance (6, 6) of the difference of the poses from two parts of one scan.

    Errors that both parts have in common cancel.

    Args:
        first: sums of the points of one part, at the pose registered from all points.
        second: the same of the other part.
        errors: systematic errors of the whole scan.
    """
    parts = ((first, -1.0), (second, 1.0))
    places = np.vstack([first.places, second.places])
    which = np.split(np.arange(len(places)), [len(first.places)])
    patches, blocks = (_numbers(places, size * errors.patch_m) for size in (1, BLOCK))
    moves, X, Y = (
        np.zeros((patches.max() + 1, 6)),
        np.zeros((blocks.max() + 1, 6, 3)),
        np.zeros((6, 17)),
    )
    for (part, sign), k in zip(parts, which, strict=True):
        inverse = _pseudo_inverse(part.normals.sum(axis=0))
        left = (1.0 + ALONE) * np.eye(6) - part.normals @ inverse
        moved = np.linalg.solve(left, _unexplained(errors, part)[:, :, None])[:, :, 0] @ inverse
        moves = moves + sign * _summed(np.asarray(moved), patches[k], len(moves))
        X = X + sign * (inverse @ _summed(part.normals[:, :, 3:], blocks[k], len(X)))
        Y = Y + sign * (inverse @ _coupling(part, errors).sum(axis=0))
    C = (
        moves.T @ moves
        + errors.block_m2 * np.tensordot(X, X, ((0, 2), (0, 2)))
        + (errors.smooth_m2 * Y) @ Y.T
    )
    return np.asarray(0.5 * (C + C.T))


def _pseudo_inverse(N: Array) -> Array:
    """Pseudo-inverse of a symmetric positive semidefinite matrix; np.linalg.pinv takes eight
    times as long.
    """
    values, vectors = np.linalg.eigh(N)
    kept = values > len(N) * np.finfo(float).eps * values[-1]
    return np.asarray((vectors[:, kept] / values[kept]) @ vectors[:, kept].T)


def _inverse(N: Array) -> Array | None:
    """Inverse of the information of a half; None if it does not determine a pose."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(N), np.finfo(float).tiny))
    values = np.linalg.eigvalsh(N * np.outer(scale, scale))
    return _pseudo_inverse(N) if values[0] * WORST_CONDITION > values[-1] else None


def _strains(found: Evidence, errors: Systematic) -> Array:
    """T (m, 3, 6): displacement of the middle of each patch per amplitude of the strain."""
    q = (found.places - errors.centre) / errors.extent_m
    T = np.zeros((len(q), 3, 6))
    for k, (i, j) in enumerate(PAIRS):
        T[:, i, k] += q[:, j]
        if i != j:
            T[:, j, k] += q[:, i]
    return T


def _coupling(found: Evidence, errors: Systematic) -> Array:
    """A (m, 6, 17): sums over each patch of J times the residual per amplitude of strain, offset
    and modes of the ranges.
    """
    of_ranges = found.normals[:, :, 3:] @ _modes(found)
    return np.concatenate([_of_surface(found, errors), of_ranges], axis=2)


def _of_surface(found: Evidence, errors: Systematic) -> Array:
    """The same (m, 6, 7) for strain and offset."""
    return np.concatenate(
        [found.normals[:, :, 3:] @ _strains(found, errors), found.offsets[:, :, None]], axis=2
    )


def _joined(found: Evidence, errors: Systematic) -> tuple[Array, Array, Array]:
    """Normal equations by patch of pose and observable amplitudes, N (m, k, k), g (m, k);
    their basis (7, k-6).
    """
    T, A = _strains(found, errors), _of_surface(found, errors)
    m, turned = len(T), T.transpose(0, 2, 1)
    F = np.zeros((m, 7, 7))
    F[:, :6, :6] = turned @ found.normals[:, 3:, 3:] @ T
    F[:, :6, 6] = F[:, 6, :6] = (turned @ found.offsets[:, 3:, None])[:, :, 0]
    F[:, 6, 6] = found.counts
    e = np.column_stack([(turned @ found.gradients[:, 3:, None])[:, :, 0], found.errors])
    coupling, total = A.sum(axis=0), found.normals.sum(axis=0)
    free = F.sum(axis=0) - coupling.T @ _pseudo_inverse(total) @ coupling
    least = OBSERVABLE * found.counts.sum()
    alone = free[:6, :6] - np.outer(free[:6, 6], free[6, :6]) / max(free[6, 6], least)
    values, vectors = np.linalg.eigh(0.5 * (alone + alone.T))
    strains = vectors[:, values > least]
    basis = np.zeros((7, strains.shape[1] + (free[6, 6] > least)))
    basis[:6, : strains.shape[1]], basis[6:, strains.shape[1] :] = strains, 1.0
    size = 6 + basis.shape[1]
    N, g = np.empty((m, size, size)), np.hstack([found.gradients, e @ basis])
    N[:, :6, :6], N[:, :6, 6:] = found.normals, A @ basis
    N[:, 6:, :6], N[:, 6:, 6:] = N[:, :6, 6:].transpose(0, 2, 1), basis.T @ F @ basis
    return N, g, basis


def _block_variance(
    N: Array,
    g: Array,
    S: Array,
    inverse: Array,
    counts: NDArray[np.int64],
    blocks: NDArray[np.intp],
) -> tuple[float, Array]:
    """Variance of the displacements of blocks by the method of moments, and its effect M (k, k) on
    the gradients.

    The products of the gradients of different patches of a block, summed, have no contribution of
    errors within patches. S (m, k, k) are the covariances of the gradients of the patches; the fit
    correlates them.
    """
    K, B = (N @ inverse)[:, 3:6], N[:, :, 3:6]
    whole, moved = _summed(N, blocks), _summed(B, blocks)
    Kb, M = (whole @ inverse)[:, 3:6], np.tensordot(moved, moved, ((0, 2), (0, 2)))
    weight = 1.0 / np.bincount(blocks, counts)
    own, total = weight[blocks], S.sum(axis=0)

    def fitted(K: Array, S: Array, total: Array, weight: Array) -> float:
        """What the fit of pose and amplitudes adds to the sum of squares of independent
        gradients.
        """
        crossed = np.einsum("cij,cij->c", K, S[:, 3:6])
        return float(weight @ (np.einsum("cij,cij->c", K @ total, K) - 2.0 * crossed))

    found = weight @ np.sum(_summed(g, blocks)[:, 3:6] ** 2, axis=1) - own @ np.sum(
        g[:, 3:6] ** 2, axis=1
    )
    found -= fitted(Kb, _summed(S, blocks), total, weight) - fitted(K, S, total, own)
    expected = weight @ np.sum(moved[:, 3:6] ** 2, axis=(1, 2)) - own @ np.sum(
        B[:, 3:6] ** 2, axis=(1, 2)
    )
    of_blocks = moved @ moved.transpose(0, 2, 1)
    of_patches = moved[blocks] @ B.transpose(0, 2, 1)
    of_patches = of_patches.transpose(0, 2, 1)
    expected += fitted(Kb, of_blocks.transpose(0, 2, 1), M, weight) - fitted(K, of_patches, M, own)
    determined = expected > LEAST_DETERMINED * float(
        weight @ np.sum(moved[:, 3:6] ** 2, axis=(1, 2))
    )
    return (max(0.0, float(found / expected)) if determined else 0.0), M


def _common_variance(values: Array, P: Array) -> float:
    """Variance t of values ~ N(0, t I + P) of greatest likelihood; 0 if not significant."""
    t, gain = _likely_variance(values, P)
    return t if gain > SIGNIFICANT else 0.0


def _likely_variance(values: Array, P: Array) -> tuple[float, float]:
    """The same by weighted moments, and twice its gain in log likelihood."""
    if not len(values):
        return 0.0, 0.0
    variances, axes = np.linalg.eigh(P)
    squares, variances = (axes.T @ values) ** 2, np.maximum(variances, np.finfo(float).tiny)
    t = max(0.0, float(np.mean(squares - variances)))
    for _ in range(ROUNDS):
        weights = 1.0 / (variances + t) ** 2
        t = max(0.0, float(weights @ (squares - variances) / weights.sum()))
    ratio = variances / (variances + t)
    return t, float(squares / variances @ (1.0 - ratio) + np.log(ratio).sum())


def _numbers(places: Array, side: float) -> NDArray[np.intp]:
    """Numbers from 0 of the occupied cubes of this side in which the places (m, 3) lie."""
    cubes = np.floor(places / side).astype(np.int64)
    cubes -= cubes.min(axis=0)
    shape = cubes.max(axis=0) + 1
    keys = (cubes[:, 0] * shape[1] + cubes[:, 1]) * shape[2] + cubes[:, 2]
    return np.asarray(np.unique(keys, return_inverse=True)[1]).reshape(-1)


def _summed(values: Array, numbers: NDArray[np.intp], count: int | None = None) -> Array:
    """Sums of values (m, ...) with the same number, (count, ...)."""
    count = int(numbers.max()) + 1 if count is None else count
    member = np.zeros((count, len(numbers)))
    member[numbers, np.arange(len(numbers))] = 1.0
    return np.asarray(member @ values.reshape(len(values), -1)).reshape(count, *values.shape[1:])
