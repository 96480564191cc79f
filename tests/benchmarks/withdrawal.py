"""Withdrawals against an independent propagation: from dense instants of plans on eight meshes.

The targets are the built-in ones, meshes given with --mesh, and random bodies of overlapping boxes.
A tumbling motion is integrated here from the inertia; distances are those of trimesh to the
triangles, their sign is the winding number summed over all triangles. From 40 random instants,
denser towards the end, also in the corridor, the withdrawal that guidance flies is propagated with
its own thrust in steps of 50 ms. The smallest margin is compared with the one that the plan states:
inside the corridor the margin of the corridor counts, outside the distance to the surface less what
is required (docs/planning.md).

python tests/benchmarks/withdrawal.py [--count 200] [--seed 1] [--mesh FILE ...]
"""

from __future__ import annotations

import argparse
import math
import time

import numpy as np
import trimesh
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from avsreplay.build import target_geometry
from avsreplay.log import read_surface
from avsreplay.plan.constrained import constrained, with_safety
from avsreplay.plan.limits import SampledScene, Scene
from avsreplay.plan.path import StepPath, path_of
from avsreplay.plan.rendezvous import PlanParams
from avsreplay.plan.robot import Limits
from avsreplay.plan.withdrawal import KEPT_SHARE, Space, escapes_at, withdrawal
from avsreplay.records import Surface
from avsreplay.simulate.target import Shape, builtin_surface

SPAN_S, STEP_S, STARTS = 160.0, 0.05, 40


def boxes(rng):
    """A body of three boxes that overlap, each closed."""
    parts = []
    for _ in range(3):
        part = trimesh.creation.box(extents=rng.uniform(0.4, 2.0, 3))
        part.apply_translation(rng.uniform(-0.5, 0.5, 3))
        parts.append(part)
    mesh = trimesh.util.concatenate(parts)
    return Surface(np.array(mesh.vertices), np.array(mesh.faces, np.int32), "boxes", "")


def grasp(surface, rng):
    """A point on the outside of the surface and its normal, seen from outside without a face in
    between.
    """
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    points, faces = trimesh.sample.sample_surface(mesh, 200, seed=int(rng.integers(2**31)))
    normals = mesh.face_normals[faces]
    clear = ~mesh.ray.intersects_any(points + 1e-4 * surface.extent * normals, normals)
    clear &= winding(mesh, points + 1e-3 * surface.extent * normals) < 0.5
    k = np.flatnonzero(clear)[0]
    return points[k], normals[k]


def winding(mesh, q):
    """Winding numbers (n,) of points (n, 3), summed over all triangles."""
    out = np.empty(len(q))
    for i, p in enumerate(q):
        a, b, c = (mesh.triangles[:, j] - p for j in range(3))
        la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
        below = la * lb * lc + np.sum(a * b, 1) * lc + np.sum(b * c, 1) * la + np.sum(c * a, 1) * lb
        out[i] = np.arctan2(np.sum(a * np.cross(b, c), 1), below).sum() / (2.0 * np.pi)
    return out


class Truth:
    """Motion and distances that share nothing with the package."""

    def __init__(self, surface, point, axis, rng):
        self.mesh = trimesh.Trimesh(surface.vertices - point, surface.faces, process=False)
        self.axis, half = axis, 0.5 * np.ptp(surface.vertices, axis=0)
        J = np.array(
            [half[1] ** 2 + half[2] ** 2, half[0] ** 2 + half[2] ** 2, half[0] ** 2 + half[1] ** 2]
        )
        w = rng.normal(size=3)
        w *= rng.uniform(0.02, 0.1) / np.linalg.norm(w)
        self.centre_c = surface.vertices.mean(axis=0) - point

        def flow(_, y):
            q, w = y[:4], y[4:]
            return np.r_[
                0.5 * (q[3] * w + np.cross(q[:3], w)), -0.5 * q[:3] @ w, -np.cross(w, J * w) / J
            ]

        times = np.arange(0.0, SPAN_S, 0.05)
        start = np.r_[Rotation.random(random_state=int(rng.integers(2**31))).as_quat(), w]
        y = solve_ivp(
            flow, [0.0, SPAN_S], start, "DOP853", rtol=1e-11, atol=1e-12, t_eval=times
        ).y.T
        self.turn = CubicSpline(times, y[:, :4])
        where = rng.normal(size=3)
        self.begin = where * 2.0 * surface.extent / np.linalg.norm(where)
        self.drift = 1e-3 * surface.extent * rng.normal(size=3)

    def attitude(self, t):
        q = self.turn(t)
        return q / np.linalg.norm(q, axis=1, keepdims=True)

    def goal(self, t):
        def at(t):
            centre = self.begin + np.outer(t, self.drift)
            return centre - Rotation.from_quat(self.attitude(t)).apply(self.centre_c)

        return at(t), (at(t + 1e-4) - at(t - 1e-4)) / 2e-4

    def local(self, t, r):
        return Rotation.from_quat(self.attitude(t)).inv().apply(r - self.goal(t)[0])

    def distance(self, y):
        """Signed distances (n,); the sign only where it matters, near the surface."""
        if not len(y):
            return np.zeros(0)
        away = trimesh.proximity.closest_point(self.mesh, y)[1]
        low, high = self.mesh.bounds
        near = np.flatnonzero(np.all((y > low) & (y < high), axis=1))
        away[near[winding(self.mesh, y[near]) > 0.52]] *= -1.0
        return away


def least(truth, limits, path, r0_t, span):
    """Smallest margin of one withdrawal, propagated here with its thrust."""
    t = np.arange(0.0, span, STEP_S)
    u = path.thrust(t + 0.5 * STEP_S)
    v = path.v0 + np.concatenate([np.zeros((1, 3)), np.cumsum(u[:-1] * STEP_S, axis=0)])
    r = path.r0 + np.concatenate(
        [np.zeros((1, 3)), np.cumsum(v[:-1] * STEP_S + 0.5 * u[:-1] * STEP_S**2, axis=0)]
    )
    y = truth.local(r0_t + t, r)
    along = y @ truth.axis
    across = np.linalg.norm(y - along[:, None] * truth.axis, axis=1)
    size = np.linalg.norm(y, axis=1)
    side = math.tan(math.radians(limits.final_deg)) * along + limits.mouth_m - across
    corridor = np.minimum(side, limits.final_range_m - size)
    near = size < 3.0 * limits.final_range_m + np.linalg.norm(truth.mesh.extents)
    gap = np.full(len(t), math.inf)
    gap[near] = truth.distance(y[near])
    required = limits.kept_m
    if corridor[0] > 0.0:
        required = min(required, KEPT_SHARE * max(gap[0], 0.0))
    return float(np.maximum(gap - required, corridor).min())


def one(surface, rng):
    """State what a plan states and what the propagation finds; None without a plan."""
    point, axis = grasp(surface, rng)
    truth, extent = Truth(surface, point, axis, rng), surface.extent
    shifted = Surface(surface.vertices - point, surface.faces, surface.name, "")
    target = target_geometry(shifted, tuple(axis))
    scene = Scene(
        truth.goal, truth.attitude, axis, truth.centre_c, target.surface, hull_c=target.hull_c
    )
    limits = Limits(final_deg=15.0, clearance_m=0.02 * extent).resolved(extent)
    params = PlanParams(a_max_mps2=0.01 * extent)
    zero = np.zeros(3)
    made = constrained(scene, zero, zero, params, limits, extent_m=extent)
    if not made.found:
        return None
    path, found = path_of(made, zero, zero), math.inf
    made = with_safety(scene, made, path, params, limits, extent)
    for t in made.t_go_s * (1.0 - rng.uniform(size=STARTS) ** 1.7):
        (r,), (v,) = path.at(np.array([t]))
        later = SampledScene(scene.after(t), 60.0, 0.2, 45.0)
        planned = None
        if isinstance(path, StepPath) and path.escapes is not None:
            (planned,) = escapes_at(path.escapes, np.array([t]))
        space = Space(later, limits, params.a_max_mps2, extent)
        flown = withdrawal(space, r, v, 0.5 * extent, planned=planned).path
        found = min(found, least(truth, limits, flown, t, flown.t_go_s + 1.0))
    return made.abort_margin_m, found, Space(later, limits, 0.01 * extent, extent).resolution_m


def main():
    args = argparse.ArgumentParser(description=__doc__)
    args.add_argument("--count", type=int, default=200)
    args.add_argument("--seed", type=int, default=1)
    args.add_argument("--mesh", nargs="*", default=[])
    args = args.parse_args()
    rng, done, begun = np.random.default_rng(args.seed), [], time.process_time()
    bodies = [builtin_surface(shape) for shape in Shape] + [read_surface(m) for m in args.mesh]
    bodies += [boxes(rng) for _ in range(max(8 - len(bodies), 2))]
    for k in range(args.count):
        surface = bodies[k % len(bodies)]
        answer = one(surface, rng)
        if answer is None:
            print(f"{k:3d} {surface.name:20s} no plan", flush=True)
            continue
        stated, found, tolerance = answer
        done.append(answer)
        broken = " CONTRADICTED" if found < stated - tolerance else ""
        print(
            f"{k:3d} {surface.name:20s} stated {stated:8.4f} found {found:8.4f} m{broken}",
            flush=True,
        )
    broken = sum(found < stated - tolerance for stated, found, tolerance in done)
    unsafe = sum(stated < 0.0 for stated, _, _ in done)
    print(
        f"{len(done)} plans of {args.count} problems, {len(bodies)} bodies: {broken} contradicted,"
        f" {unsafe} state a negative margin; {time.process_time() - begun:.0f} s"
    )


if __name__ == "__main__":
    main()
