"""Properties of registration: signs, frames, quality, unobservable directions of a view,
visible faces.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from oracles import covariance as oracle_of
from oracles.residuals import residuals, summed
from scipy.spatial.transform import Rotation

from avsreplay import geometry
from avsreplay.geometry import Pose, exp
from avsreplay.records import AlignStatus, Fit, Surface
from avsreplay.register.backend import Backend
from avsreplay.register.contract import example_pose, plate_scan, view
from avsreplay.register.covariance import systematic_errors, without_dominant_patches
from avsreplay.register.degenerate import Directions
from avsreplay.register.params import Camera, RegisterParams
from avsreplay.register.peers import best_motion, horn_matrix
from avsreplay.register.quality import evidence, grade
from avsreplay.register.registrar import Registrar
from avsreplay.register.sampling import sample, thin
from avsreplay.register.surface_index import SurfaceIndex
from avsreplay.register.visibility import Visibility
from avsreplay.simulate.target import box

RNG_SEED = 11


def _rng() -> np.random.Generator:
    return np.random.default_rng(RNG_SEED)


@pytest.fixture(scope="module")
def registrar(surface: Surface) -> Registrar:
    return Registrar(surface)


# --- Horn's closed form


def test_horn_recovers_any_motion_exactly() -> None:
    rng = _rng()
    for _ in range(50):
        truth = Pose(rng.normal(size=4), rng.normal(size=3))
        moving = rng.normal(size=(8, 3))
        found = best_motion(moving, truth.apply(moving))
        np.testing.assert_allclose(found.matrix, truth.matrix, atol=1e-12)


def test_horn_agrees_with_the_singular_value_solution() -> None:
    rng = _rng()
    for _ in range(20):
        moving, fixed = rng.normal(size=(30, 3)), rng.normal(size=(30, 3))
        oracle = Rotation.align_vectors(fixed - fixed.mean(0), moving - moving.mean(0))[
            0
        ].as_matrix()
        np.testing.assert_allclose(best_motion(moving, fixed).R, oracle, atol=1e-9)


def test_horn_matrix_is_scalar_first() -> None:
    """No motion must give [1 0 0 0] as the largest eigenvector; read scalar last it would be
    a half turn (errata).
    """
    points = _rng().normal(size=(20, 3))
    centred = points - points.mean(axis=0)
    vector = np.linalg.eigh(horn_matrix(centred.T @ centred / 20))[1][:, -1]
    np.testing.assert_allclose(np.abs(vector), [1, 0, 0, 0], atol=1e-12)


# --- the registrar


@pytest.mark.parametrize("backend", ["horn", "reference"])
def test_an_exact_scan_is_registered_to_rounding(
    surface: Surface, scan: np.ndarray, backend: str
) -> None:
    T_ac = example_pose()
    guess = T_ac @ Pose(exp(np.radians([2.0, -3.0, 1.5])), np.array([0.04, -0.05, 0.03]))
    params = RegisterParams(
        backend=backend, eps_rad=1e-7, eps_m=1e-7, n_max=1000
    )  # Horn alone settles slowly
    found = Registrar(surface, params).register(scan, guess)
    assert found.status is AlignStatus.ALIGNED
    step = T_ac.inverse() @ found.T_ac
    assert float(geometry.angle(step.q)) < 1e-5
    assert np.linalg.norm(step.t) < 2e-5
    assert found.inliers == len(scan) == found.points


def test_horn_and_reference_end_at_the_same_pose(surface: Surface, scan: np.ndarray) -> None:
    """Plane passes first or not, kernel or numpy: the fixed point of Horn's pass is one."""
    rng = _rng()
    noisy = scan + rng.normal(0.0, 0.008, scan.shape)
    guess = example_pose() @ Pose(exp([0.01, 0.02, -0.01]), np.array([0.02, 0.0, -0.02]))
    params = RegisterParams(camera=Camera.NONE, eps_rad=1e-7, eps_m=1e-7, n_max=1000)
    first = Registrar(surface, params).register(noisy, guess)
    second = Registrar(surface, replace(params, backend="reference")).register(noisy, guess)
    step = first.T_ac.inverse() @ second.T_ac
    assert float(geometry.angle(step.q)) < 2e-5
    assert np.linalg.norm(step.t) < 5e-5


def test_empty_and_missing_points_keep_the_guess(registrar: Registrar) -> None:
    guess = example_pose()
    for points in (np.empty((0, 3)), np.full((4, 3), np.nan, dtype=np.float32)):
        found = registrar.register(points, guess)
        assert found.status is AlignStatus.NO_POINTS
        assert found.T_ac.t.tobytes() == guess.t.tobytes()
        assert found.inlier_ratio == 0.0


def test_subsampling_keeps_the_pose(surface: Surface, scan: np.ndarray) -> None:
    found = Registrar(surface, RegisterParams(subsample_m=0.1)).register(scan, example_pose())
    assert 100 < found.points < len(scan) / 1.5
    assert np.linalg.norm(found.T_ac.t - example_pose().t) < 1e-4


class _Raising(Backend):
    name = "raising"

    def align(self, points, guess):
        raise ZeroDivisionError


class _NotFinite(_Raising):
    def align(self, points, guess):
        return Fit(Pose(guess.q, np.array([np.nan, 0.0, 0.0])), 1, True)


@pytest.mark.parametrize("fake", [_Raising, _NotFinite])
def test_a_failure_of_a_back_end_is_a_status(
    monkeypatch, surface: Surface, scan: np.ndarray, fake
) -> None:
    monkeypatch.setattr("avsreplay.register.registrar.load_backend", lambda name: fake)
    found = Registrar(surface).register(scan, example_pose())
    assert found.status is AlignStatus.FAILED
    assert np.isfinite(found.T_ac.matrix).all()


class _Unchanged(_Raising):
    def align(self, points, guess):
        return Fit(guess, 3, True)


class _NearGuess(_Raising):
    def align(self, points, guess):
        return Fit(Pose(guess.q, guess.t + 1e-9), 3, True)


def _off(degrees: float) -> Pose:
    return example_pose() @ Pose(exp([0.0, np.radians(degrees), 0.0]), np.zeros(3))


def test_a_guess_that_is_returned_unchanged_is_no_measurement(
    monkeypatch, surface: Surface, scan: np.ndarray
) -> None:
    """Even a good guess: it says nothing of this scan, and the filter would take it as a
    perfect confirmation.
    """
    monkeypatch.setattr("avsreplay.register.registrar.load_backend", lambda name: _Unchanged)
    noisy = scan + np.random.default_rng(3).normal(0.0, 0.005, scan.shape)
    for degrees in (0.02, 0.5, 3.0):
        found = Registrar(surface).register(noisy, _off(degrees))
        assert found.status is AlignStatus.FAILED, degrees
        assert "unchanged" in found.message


def test_a_scan_beside_the_target_is_no_failure_of_the_back_end(
    registrar: Registrar, scan: np.ndarray
) -> None:
    guess = example_pose()
    found = registrar.register(scan + np.array([40.0, 0.0, 0.0]), guess)
    assert (found.status, found.message) == (AlignStatus.NO_OVERLAP, "")
    np.testing.assert_allclose(found.T_ac.t, guess.t, atol=1e-12)


def test_a_false_claim_of_convergence_is_found(
    monkeypatch, surface: Surface, scan: np.ndarray
) -> None:
    monkeypatch.setattr("avsreplay.register.registrar.load_backend", lambda name: _NearGuess)
    found = Registrar(surface).register(scan, _off(0.4))
    assert not found.converged
    assert found.status is not AlignStatus.ALIGNED


# --- the ruler


def test_information_is_the_curvature_of_the_cost(
    surface: Surface, registrar: Registrar, scan: np.ndarray
) -> None:
    """J of the ruler against finite differences of the residuals, in d of T_ac_true = T_ac @
    Exp(d).
    """
    T_ac = example_pose()
    model = SurfaceIndex.build(surface, 0.5)
    base = residuals(model, Visibility(surface), scan, T_ac.inverse(), 0.05)
    h = 1e-6
    for k in range(6):
        d = np.zeros(6)
        d[k] = h
        moved = T_ac @ Pose(exp(-d[:3]), -d[3:])  # the measured pose that is off by d (first order)
        shifted = residuals(model, Visibility(surface), scan, moved.inverse(), 0.05)
        if shifted.inliers != base.inliers:
            pytest.fail("the step changed the inliers")
        slope = (shifted.e - base.e) / h
        inside = np.abs(slope - base.J[:, k]) < 1e-3
        assert (
            inside.mean() > 0.97
        )  # the rest have their foot on an edge, where the foot slides to another face


def test_sums_over_patches_are_those_of_the_residuals(surface: Surface, scan: np.ndarray) -> None:
    """The kernel's sums against numpy, point by point; the patches in any order; few patches:
    a point each.
    """
    T_ca, index = example_pose().inverse(), SurfaceIndex.build(surface, 0.5)
    for points in (scan, scan[:40], scan[:1], scan[:0]):
        plain = residuals(index, Visibility(surface), points, T_ca, 0.05)
        found = evidence(index, Visibility(surface), points, T_ca, 0.05)
        assert (found.points, found.inliers) == (len(points), plain.inliers)
        assert len(found.counts) == plain.patch.max(initial=-1) + 1
        assert sorted(found.counts) == sorted(np.bincount(plain.patch))
        np.testing.assert_allclose(
            found.normals.sum(axis=0), plain.J.T @ plain.J, rtol=1e-10, atol=1e-9
        )
        np.testing.assert_allclose(
            found.gradients.sum(axis=0), plain.J.T @ plain.e, rtol=1e-9, atol=1e-9
        )
        if plain.inliers:
            np.testing.assert_allclose(found.centre, plain.p.mean(axis=0), atol=1e-12)
            assert found.rms_m == pytest.approx(np.sqrt(plain.d2.mean()), rel=1e-12)
            assert found.noise_m == pytest.approx(
                max(1.4826 * np.median(np.abs(plain.e)), 5e-8), rel=1e-9
            )
            whole = summed(plain.J, plain.e, plain.patch)
            order = np.argsort(
                np.unique(plain.patch, return_index=True)[1]
            )  # by the first point of each patch
            np.testing.assert_allclose(found.normals, whole.normals[order], rtol=1e-8, atol=1e-9)
            np.testing.assert_allclose(
                found.gradients, whole.gradients[order], rtol=1e-8, atol=1e-9
            )


def test_the_noise_of_a_face_near_the_boundary_of_patches_does_not_correlate_them() -> None:
    """Patches are parts of the model.

    Those of the measured points would divide the face by the sign of the noise.
    """
    low, high, rng = (
        np.array([-0.6, -0.5, -0.4]),
        np.array([0.55, 0.45, 0.001]),
        np.random.default_rng(4),
    )
    solid = box(low, high)
    surface = Surface(solid.vertices, solid.faces, "box", "")
    index, noise, values = SurfaceIndex.build(surface, 0.5), 0.004, []
    for _ in range(20):
        p = rng.uniform(low, high, (1500, 3))
        p[:, 2] = np.where(np.arange(1500) < 1100, high[2], p[:, 2])
        p[1100:1300, 0], p[1300:, 1] = high[0], high[1]
        p += noise * rng.normal(size=(1500, 1)) * np.eye(3)[np.repeat([2, 0, 1], [1100, 200, 200])]
        found = evidence(index, Visibility(surface), p, Pose.identity(), 0.05)
        values.append(systematic_errors(found, surface.extent, 0.05 * surface.extent).block_m2)
    assert np.sqrt(np.mean(values)) < 0.1 * noise


@pytest.mark.parametrize(
    ("noise_m", "squeeze", "systematic"),
    [(0.01, 0.0, True), (0.002, 0.02, True), (0.01, 0.0, False)],
)
def test_the_grade_follows_from_the_sums_over_patches(
    surface: Surface, scan: np.ndarray, noise_m: float, squeeze: float, systematic: bool
) -> None:
    """One call of the kernel gives what numpy makes of the sums, the covariance and the test of
    halves.
    """
    points = scan * [1.0 + squeeze, 1.0, 1.0] + _rng().normal(0.0, noise_m, scan.shape)
    index, visibility, params = (
        SurfaceIndex.build(surface, 0.5),
        Visibility(surface),
        RegisterParams(),
    )
    limits = params.limits(surface.extent)
    T_ca = Registrar(surface).register(points, example_pose()).T_ac.inverse()
    found = grade(
        index, visibility, points, Fit(T_ca, 1, True), limits, params, systematic=systematic
    )
    sums = evidence(index, visibility, points, T_ca, limits.gate_m)
    assert (found.points, found.inliers, found.rms_m) == (sums.points, sums.inliers, sums.rms_m)
    sums = without_dominant_patches(sums)
    np.testing.assert_allclose(found.info, sums.normals.sum(axis=0) / sums.noise_m**2, rtol=1e-12)
    errors = oracle_of.systematic_errors(sums, surface.extent, 0.05 * surface.extent)
    bare = oracle_of.sandwich_covariance(sums.normals, sums.gradients)
    P, dof = oracle_of.registration_covariance(sums, errors) if systematic else bare
    assert not found.message  # no size is fitted, whose effect on the pose would be added
    np.testing.assert_allclose(found.covariance, P, rtol=1e-7, atol=1e-12 * np.abs(P).max())
    assert found.dof == pytest.approx(dof, rel=1e-6)
    assert found.split_nis == pytest.approx(
        oracle_of.split_nis(sums, errors, T_ca.R[:, :2].T), rel=1e-6
    )


def test_covariance_shrinks_with_points_and_grows_with_noise(
    surface: Surface, registrar: Registrar
) -> None:
    T_ac, rng = example_pose(), _rng()
    exact = {n: T_ac.apply(view(surface, n, T_ac.inverse().t)) for n in (3000, 12000)}

    def trace(n: int, sigma: float) -> float:
        found = registrar.register(exact[n] + rng.normal(0, sigma, exact[n].shape), T_ac)
        return float(np.trace(found.covariance))

    assert trace(3000, 0.01) / trace(12000, 0.01) == pytest.approx(4.0, rel=0.5)
    assert trace(3000, 0.01) / trace(3000, 0.005) == pytest.approx(4.0, rel=0.5)


def test_no_overlap_whatever_the_flag_says(surface: Surface, scan: np.ndarray) -> None:
    params = RegisterParams()
    far = Fit(Pose(example_pose().inverse().q, np.full(3, 1e3)), 1, True)
    found = grade(
        SurfaceIndex.build(surface, 0.5),
        Visibility(surface),
        scan,
        far,
        params.limits(surface.extent),
        params,
    )
    assert found.status is AlignStatus.NO_OVERLAP
    assert (found.inliers, found.covariance) == (0, None)


def test_a_registration_that_did_not_converge_is_reported_and_graded(
    surface: Surface, scan: np.ndarray
) -> None:
    guess = example_pose() @ Pose(exp([0.05, 0.0, 0.0]), np.zeros(3))
    found = Registrar(surface, RegisterParams(n_max=2)).register(scan, guess)
    assert found.status is AlignStatus.NOT_CONVERGED
    assert found.iterations == 2
    assert found.inliers > 0


@pytest.mark.parametrize("late_far", [False, True])
def test_instants_say_which_pose_a_moving_scan_is_registered_at(
    registrar: Registrar, surface: Surface, scan: np.ndarray, late_far: bool
) -> None:
    """The target drifts by t d1 while it is scanned, along one side or at random: the pose
    found is off by M d1.
    """
    T_ac, rng = example_pose(), _rng()
    body = T_ac.inverse().apply(scan)
    times = rng.uniform(0.0, 1.0, len(scan))
    if late_far:
        times[np.argsort(body[:, 1])] = np.sort(times)
    d1 = np.array([2e-3, -1e-3, 1.5e-3, 1e-3, 2e-3, -1e-3])
    moved = T_ac.apply(body + times[:, None] * (np.cross(d1[:3], body) + d1[3:]))
    found = Registrar(surface, RegisterParams(eps_rad=1e-7, eps_m=1e-7, n_max=1000)).register(
        moved, T_ac
    )
    step = T_ac.inverse() @ found.T_ac
    d = np.concatenate([geometry.log(step.q), step.t])
    M = registrar.instants(moved, times, found.T_ac)
    np.testing.assert_allclose(d, M @ d1, atol=0.04 * np.abs(d).max())
    assert (np.abs(M - 0.5 * np.eye(6)).max() > 0.1) == late_far


def test_points_of_one_instant_have_it_in_every_direction(
    registrar: Registrar, scan: np.ndarray
) -> None:
    M = registrar.instants(scan, np.full(len(scan), 0.3), example_pose())
    np.testing.assert_allclose(M, 0.3 * np.eye(6), atol=1e-12)


# --- what a view leaves free


def _free(J: np.ndarray, centre: np.ndarray) -> tuple[str, ...]:
    return Directions.of(J.T @ J, len(J), centre).words


def _plane(normal: np.ndarray, about: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    rng = _rng()
    u, v = np.linalg.svd(normal[None])[2][1:]
    points = about + rng.uniform(-1, 1, (500, 1)) * u + rng.uniform(-1, 1, (500, 1)) * v
    n = np.broadcast_to(normal, points.shape)
    return np.hstack([np.cross(points, n), n]), points.mean(axis=0)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_plane_slides_along_two_axes_and_turns_about_the_third(axis: int) -> None:
    names = "xyz"
    found = _free(*_plane(np.eye(3)[axis], np.array([3.0, -2.0, 1.0])))
    others = [f"slides along {names[k]}" for k in range(3) if k != axis]
    assert sorted(found) == sorted([*others, f"turns about {names[axis]}"])


def test_a_cylinder_slides_along_and_turns_about_its_axis() -> None:
    rng = _rng()
    angle, z = rng.uniform(0, 2 * np.pi, 2000), rng.uniform(-1, 1, 2000)
    n = np.stack([np.cos(angle), np.sin(angle), np.zeros(2000)], axis=1)
    points = 0.5 * n + np.array([0, 0, 1.0]) * z[:, None]
    assert sorted(_free(np.hstack([np.cross(points, n), n]), points.mean(0))) == [
        "slides along z",
        "turns about z",
    ]


def test_a_sphere_turns_about_everything_and_a_full_view_about_nothing(surface: Surface) -> None:
    n = _rng().normal(size=(3000, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    assert sorted(_free(np.hstack([np.cross(n, n), n]), np.zeros(3))) == [
        f"turns about {axis}" for axis in "xyz"
    ]
    points, normals = sample(surface, 3000)
    assert _free(np.hstack([np.cross(points, normals), normals]), points.mean(0)) == ()


def test_a_slanted_slide_is_named_by_its_direction() -> None:
    found = _free(*_plane(np.array([1.0, 1.0, 0.0]) / np.sqrt(2), np.zeros(3)))
    assert "slides along z" in found
    assert any(words.startswith("slides along (") for words in found)


def test_a_degenerate_view_has_no_covariance(registrar: Registrar) -> None:
    T_ac = example_pose()
    found = registrar.register(T_ac.apply(plate_scan()), T_ac)
    assert found.status is AlignStatus.DEGENERATE
    assert found.covariance is None
    assert "slides along x" in found.free_directions


@pytest.mark.parametrize("guess_deg", [0.0, 3.0])
def test_a_cylinder_seen_from_the_side_keeps_its_place_along_the_axis(guess_deg: float) -> None:
    """The middle of the barrel alone determines neither the position along the axis nor the
    rotation about it.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, 65)[:-1]
    rim = np.column_stack([1.8 * np.cos(angle), 1.8 * np.sin(angle), np.zeros(64)])
    k, n = np.arange(64), (np.arange(64) + 1) % 64
    faces = np.vstack(
        [np.column_stack([k, n, k + 64]), np.column_stack([n, n + 64, k + 64])]
    ).astype(np.int32)
    up = np.array([0.0, 0.0, 4.5])
    barrel = Surface(np.vstack([rim - up, rim + up]), faces, "barrel", "")
    rng, T_ac = _rng(), Pose(exp([np.pi / 2, 0.0, 0.0]), np.array([0.0, 0.0, 20.0]))
    a, z = rng.uniform(0.0, 2.0 * np.pi, 20000), rng.uniform(-3.0, 3.0, 20000)
    normals = np.column_stack([np.cos(a), np.sin(a), 0.0 * a])
    points = T_ac.apply(1.8 * normals + z[:, None] * [0.0, 0.0, 1.0])
    seen = np.einsum("ij,ij->i", normals @ T_ac.R.T, points) < -0.2 * np.linalg.norm(points, axis=1)
    scan = points[seen][:3000] + rng.normal(0.0, 0.01, (3000, 3))
    guess = T_ac @ Pose(exp(np.radians(guess_deg) * np.array([0.8, 0.6, 0.0])), np.zeros(3))
    found = Registrar(barrel).register(scan, guess)
    step = T_ac.inverse() @ found.T_ac
    assert found.status is AlignStatus.DEGENERATE
    assert "slides along z" in found.free_directions
    assert np.degrees(np.arccos(step.R[2, 2])) < 0.1  # the axis is found
    assert np.linalg.norm(step.t[:2]) < 0.01
    if guess_deg == 0.0:
        assert (
            abs(np.degrees(geometry.log(step.q)[2])) < 0.05
        )  # the rotation about it stays that of the guess
    # The position along it stays that of the guess, where the surface was seen: one radius beside
    # the axis.
    assert abs(step.t[2]) < 1.8 * np.radians(guess_deg) + 0.002


# --- sampling


def test_samples_lie_on_the_surface_evenly_and_repeat(surface: Surface) -> None:
    points, normals = sample(surface, 5000)
    found = SurfaceIndex.build(surface, 0.5).closest(points)
    assert found.d2.max() < 1e-20
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    counts = np.bincount(found.id, minlength=len(area))
    big = area > 0.02 * area.sum()
    np.testing.assert_allclose(counts[big] / 5000, area[big] / area.sum(), rtol=0.1)
    assert sample(surface, 5000)[0].tobytes() == points.tobytes()


def test_thin_keeps_one_point_a_voxel_in_order() -> None:
    points = _rng().uniform(-1, 1, (2000, 3))
    kept = thin(points, 0.5)
    cells = {tuple(row) for row in np.floor(points / 0.5).astype(int)}
    assert len(kept) == len(cells)
    rows = [int(np.flatnonzero((points == row).all(axis=1))[0]) for row in kept]
    assert rows == sorted(rows)


# --- parameters


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("reach_m", 0.0),
        ("gate_m", -1.0),
        ("n_max", 0),
        ("threads", 0),
        ("min_inlier_ratio", 1.5),
        ("eps_rad", np.nan),
    ],
)
def test_a_value_that_cannot_be_right_is_named(key: str, value: float) -> None:
    with pytest.raises(ValueError, match=key):
        RegisterParams(**{key: value})


def test_lengths_scale_with_the_model() -> None:
    small, large = RegisterParams().limits(0.25), RegisterParams().limits(8.0)
    assert (
        large.reach_m / small.reach_m
        == large.gate_m / small.gate_m
        == large.eps_m / small.eps_m
        == 32.0
    )
    assert RegisterParams(gate_m=0.5).limits(1.0).reach_m >= 0.5


def test_points_of_a_single_face_lie_on_it() -> None:
    corners = np.array([[0.0, 0.0, 1.0], [2.0, 0.0, 1.0], [0.0, 3.0, 1.0]])
    face = Surface(corners, np.array([[0, 1, 2]], dtype=np.int32), "face", "")
    points, normals = sample(face, 500)
    assert abs(len(points) - 500) <= 1
    np.testing.assert_allclose(normals, np.tile([0.0, 0.0, 1.0], (len(points), 1)))
    np.testing.assert_allclose(points[:, 2], 1.0)
    assert (points[:, :2] >= 0.0).all()
    assert (points[:, 0] / 2.0 + points[:, 1] / 3.0 <= 1.0 + 1e-12).all()
    np.testing.assert_allclose(points.mean(axis=0), corners.mean(axis=0), atol=0.1)
