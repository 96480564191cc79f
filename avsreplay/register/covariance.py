"""Covariance of a registered pose from its residuals: random errors by patches, and systematic
errors.

With J = [p x n, n] and e = n . (p - closest point), the pose error d = [theta; v] in {C} appears as
e = J d + noise. Two kinds of errors correlate the noise of points:

Random errors They are alike within a patch (a detail that the model lacks, a stripe of a range
    image). Their covariance is the sandwich estimate with patches as clusters, in the form without
    bias for independent noise (Bell and McCaffrey, Survey Methodology 28, 2002). From a few patches
    it is too small in some direction. It is therefore shrunk towards the covariance of independent
    noise at the same mean level (Ledoit and Wolf, J. Multivariate Analysis 88, 2004). Displacements
    that neighbouring patches share, independent from one block of 4 patches a side to the next, add
    a variance; it is estimated from the products of residuals of different patches of a block.
Systematic errors Errors of the model or of the ranges that vary slowly over the target: a symmetric
    strain and an offset of the surface (size, aspect, shear, calibration of the scanner, thickness
    of paint or of the mesh). They are fitted with the pose; the amplitudes of the strain are taken
    as draws of one normal distribution, that of the offset of another. Their variances are maximum
    likelihood estimates (empirical Bayes), 0 if not significant.
Errors of the ranges They vary slowly over the image (calibration, multipath) and move the surface
    along the rays: a polynomial of third degree over the image, whose terms are draws of a third
    distribution, that of a random field of one of three lengths, each weighted with its likelihood.
    Its constant and linear terms look like a motion, so that no residual shows them; their variance
    follows from that of the other terms and the length. They are fitted where the position of the
    camera is known. The covariance of the fitted terms is that of the residuals which they leave;
    that of all residuals contains the error itself and hides it where few faces see a term.

The covariance is an estimate from some hundred patches: the squared error of a pose in its metric
is Hotelling's T^2, not chi-square. Its degrees of freedom are those of a Wishart matrix with the
same mean and the same expected squared error, which Ledoit and Wolf estimate from the differences
between the patches. For the sum with the systematic errors they follow from Welch and
Satterthwaite, for matrices by Nel and van der Merwe (Communications in Statistics, Theory and
Methods 15, 1986).

``split_nis`` tests the result: pose from one half of the patches against the other, normalised with
the covariance of their difference, in which common errors cancel. For normal errors it is
chi-square with 6 degrees of freedom.

The sums run over patches in C++ (``kernel/systematic.cpp``, ``kernel/covariance.cpp``), where the
thresholds are.
"""

from __future__ import annotations

from dataclasses import fields, replace
from functools import lru_cache
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import value_class
from avsreplay.geometry import Array
from avsreplay.register.surface_index import kernel_module


@value_class
class Evidence:
    """Sums over the inliers at a pose, by patches of the model; all in {C}.

    Attributes:
        points: points of the scan.
        inliers: points nearer than the gate to the model, or to its faces that face the camera if
            that is known.
        rms_m: rms of their distances.
        centre: (3,) centroid of the inliers.
        noise_m: robust standard deviation of e = n . (p - closest point).
        counts: (m,) inliers of each patch.
        normals: (m, 6, 6) sums of J'J over each patch.
        gradients: (m, 6) sums of e J over each patch.
        offsets: (m, 6) sums of J over each patch.
        errors: (m,) sums of e.
        places: (m, 3) centroid of the points of each patch, projected onto their faces.
        camera_c: (3,) the camera in {C}; None where it is not known.
    """

    points: int
    inliers: int
    rms_m: float
    centre: Array
    noise_m: float
    counts: NDArray[np.int64]
    normals: Array
    gradients: Array
    offsets: Array
    errors: Array
    places: Array
    camera_c: Array | None = None

    def only(self, keep: NDArray[np.bool_]) -> Evidence:
        """Return the evidence of the patches with ``keep`` (m,) true."""
        names = [f.name for f in fields(self)]
        of_patches = names[names.index("counts") : names.index("camera_c")]
        return replace(self, **{name: getattr(self, name)[keep] for name in of_patches})


@value_class
class Systematic:
    """Errors of a scan that the sandwich estimate over patches does not contain.

    Attributes:
        extent_m: diagonal of the model's bounding box; the strains are per this length.
        patch_m: side of a patch.
        block_m2: variance of the displacement of a block, each axis [m^2].
        smooth_m2: (17,) variances of the amplitudes: six of the strain times the extent, the
            offset, and ten modes of the ranges [m^2].
        amplitudes: (17,) their fitted values [m].
        centre: (3,) about which the strain was fitted.
        fit: (6,) pose part of the common fit of pose and amplitudes.
    """

    extent_m: float
    patch_m: float
    block_m2: float
    smooth_m2: Array
    amplitudes: Array
    fit: Array
    centre: Array

    @property
    def values(self) -> tuple[float, list[float], list[float], list[float]]:
        """Variance of blocks, variances and values of the amplitudes, and the fit, as the kernel
        takes them.
        """
        return (
            float(self.block_m2),
            self.smooth_m2.tolist(),
            self.amplitudes.tolist(),
            self.fit.tolist(),
        )


def without_dominant_patches(found: Evidence) -> Evidence:
    """Return the evidence without the patches that give more than half of the information on some
    motion.

    Example: the barely visible side of a box is determined by a few points next to its edge.
    """
    keep = kernel_module().keep_patches(*_contiguous(found.normals), found.counts)
    return found if keep.all() else found.only(keep)


def sandwich_covariance(normals: Array, gradients: Array) -> tuple[Array, float]:
    """Return the cluster-robust sandwich covariance (6, 6) of d = [theta; v] and its degrees of
    freedom.

    Clusters are patches of the model: errors within one may be correlated, patches are taken as
    independent. With N the sum of N_p = J'J, g_p = sum of e J and N^-1 = W W', patch p adds the
    square of (I - W' N_p W)^-1/2 W' g_p. The sum S is shrunk towards trace(S) / 6 times the
    identity; the covariance is W S W'.

    Args:
        normals: (m, 6, 6) sums of J'J.
        gradients: (m, 6) sums of e J.
    """
    found: tuple[Array, float] = kernel_module().sandwich(*_contiguous(normals, gradients))
    return found


def pseudo_inverse(N: Array) -> Array:
    """Return the pseudo-inverse (6, 6) of a symmetric positive semidefinite matrix."""
    inverse: Array = kernel_module().pseudo_inverse(*_contiguous(N))
    return inverse


def systematic_errors(found: Evidence, extent_m: float, patch_m: float) -> Systematic:
    """Estimate the systematic errors of a scan from the structure of its residuals.

    Args:
        found: sums at the registered pose.
        extent_m: diagonal of the model's bounding box.
        patch_m: side of a patch.

    Returns:
        The variances; zero where every patch is a single point, or there are fewer than 24 patches.
    """
    block_m2, smooth_m2, amplitudes, fit = _table(
        found, found.centre, extent_m, patch_m
    ).systematic()
    return Systematic(extent_m, patch_m, block_m2, smooth_m2, amplitudes, fit, found.centre)


def patch_size(found: Evidence, extent_m: float, patch_m: float) -> tuple[float, float]:
    """Return the size of the target over that of the model, less 1, and its standard error, from
    the sums of patches.

    The size is fitted with the pose by linear least squares, with a patch as one point for the
    size. The standard error is the cluster-robust one over the patches, infinite where a pose
    explains any size: three faces of a box.

    Args:
        found: sums at the registered pose.
        extent_m: diagonal of the model's bounding box.
        patch_m: side of a patch.
    """
    delta, sigma = _table(found, found.centre, extent_m, patch_m).size_error()
    return float(delta), float(sigma)


def registration_covariance(found: Evidence, errors: Systematic) -> tuple[Array, float]:
    """Return the covariance (6, 6) of the registered pose, systematic errors included, and its
    degrees of freedom.

    Args:
        found: sums at the registered pose.
        errors: its systematic errors.
    """
    estimate: tuple[Array, float] = _table_of(found, errors).covariance(*errors.values)
    return estimate


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
    value = float(_table_of(found, errors).split(*errors.values, *_contiguous(across)))
    return None if np.isnan(value) else value


def noise_along(rays: Array, normal: Array, residual: Array, weight: Array) -> Array:
    """Return normal noise (k,) along rays [m] that gives residuals along the normals of the same
    mean square.

    Args:
        rays: (k, 3) unit vectors.
        normal: (k, 3) unit normals of the model.
        residual: (k,) residuals times ``weight`` [m].
        weight: (k,) square root of the weight of each residual.
    """
    along = weight * np.einsum("ij,ij->i", rays, normal)
    size = np.sqrt(float(residual @ residual) / max(float(along @ along), np.finfo(float).tiny))
    return np.asarray(size * normal_numbers(1 << len(rays).bit_length())[: len(rays)])


@lru_cache(maxsize=4)
def normal_numbers(count: int) -> Array:
    """Return normal numbers (count,), the first of them evenly distributed as well; read-only."""
    share = (0.5 + np.arange(count) * (0.5 * (np.sqrt(5.0) - 1.0))) % 1.0
    numbers = np.array([NormalDist().inv_cdf(float(x)) for x in share])
    numbers.flags.writeable = False
    return numbers


def _table_of(found: Evidence, errors: Systematic) -> Any:
    return _table(found, errors.centre, errors.extent_m, errors.patch_m)


def _table(found: Evidence, centre: Array, extent_m: float, patch_m: float) -> Any:
    """The sums as the kernel takes them."""
    sums = (*_contiguous(found.normals, found.gradients, found.offsets), found.counts)
    lengths = (tuple(centre.tolist()), float(extent_m), float(patch_m))
    camera = (np.nan,) * 3 if found.camera_c is None else tuple(found.camera_c.tolist())
    return kernel_module().Table(*sums, *_contiguous(found.errors, found.places), *lengths, camera)


def _contiguous(*arrays: Array) -> tuple[Array, ...]:
    return tuple(np.ascontiguousarray(each, dtype=np.float64) for each in arrays)
