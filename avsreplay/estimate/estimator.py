"""The estimator as the replay uses it: pure functions from one immutable track to the next.

Modes: ``near`` uses a given start until the first healthy scan, ``start`` the first poses of a cold
start, ``fit`` the maximum-likelihood fit over all poses so far, ``filter`` the Kalman filter
afterwards. The filter is compared with a fit at intervals; where the fit contradicts it, the fit is
used again.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from avsreplay.errors import UsageError
from avsreplay.estimate import _motion, dynamics
from avsreplay.estimate.acceleration import accelerated
from avsreplay.estimate.anomalies import AnomalyTest
from avsreplay.estimate.batch_schedule import BatchSchedule
from avsreplay.estimate.chart import ANY_HALF_RAD
from avsreplay.estimate.common_errors import ModelErrors, motion_covariance
from avsreplay.estimate.disturbance_schedule import DisturbanceSchedule
from avsreplay.estimate.driven import DrivenBelief, drive_in, driven_forecast, propagated
from avsreplay.estimate.error_state import RHO, semidefinite
from avsreplay.estimate.frame import ZERO, EstimatorFrame
from avsreplay.estimate.grasp_point import at_grasp
from avsreplay.estimate.initialise import given_prior, guessed_belief
from avsreplay.estimate.measurement import (
    gate_of,
    in_camera,
    innovation_of,
    innovation_vector,
    measured_pose,
    measurement_jacobian,
    residual,
)
from avsreplay.estimate.mixture import mixture_forecast
from avsreplay.estimate.noise import NO_INFLATION, Noise, NoiseWindow
from avsreplay.estimate.params import EstimatorParams, Start
from avsreplay.estimate.reference import FittedMotion, GramianRows, rows_along
from avsreplay.estimate.relative_orbit import RelativeOrbit
from avsreplay.estimate.track import (
    Epoch,
    Prediction,
    Track,
    common_1s,
    common_motions,
    turned,
    undetermined,
)
from avsreplay.geometry import Array, Pose
from avsreplay.records import (
    Admission,
    Alignment,
    Belief,
    Finding,
    Forecast,
    Innovation,
    Trajectory,
)


class Estimator:
    """The 20-state noise-adaptive constrained Kalman filter and the batch fit that initialises and
    checks it.
    """

    def __init__(
        self,
        params: EstimatorParams,
        start: Belief | None,
        extent_m: float,
        epoch_ns: int = 0,
        centre_c: Array = ZERO,
    ) -> None:
        """Create the estimator of one run.

        Args:
            params: settings; lengths left out are taken from ``extent_m``.
            start: the first belief where one is given.
            extent_m: the target's bounding diagonal [m].
            epoch_ns: of the first scan: the falling frame then coincides with {A}; directions of an
                orbit belong to it.
            centre_c: (3,) centre of the target's bounding box in {C} [m]; the paper's method does
                not use it.

        Raises:
            UsageError: a near start is requested and none is given.
        """
        self.params = params.resolved(extent_m)
        if params.start is Start.NEAR and start is None:
            hint = "use start = cold, or a log whose scenario has a [start] table"
            raise UsageError(
                "a near start is requested and the log contains none",
                where="estimator.start",
                hint=hint,
            )
        middle = ZERO if params.start is Start.PAPER else centre_c
        self.frame = EstimatorFrame(middle, np.array(params.acceleration_mps2), epoch_ns)
        given = start if params.start in (Start.AUTO, Start.NEAR) else None
        self.start = None if given is None else self.frame.belief_into(given)
        self.noise = Noise(self.params, extent_m)
        self.batch = BatchSchedule(
            self.params, self.noise, self.start, RelativeOrbit.of(params, epoch_ns)
        )
        self.anomalies = AnomalyTest(self.params, extent_m, self.batch, self._replayed)
        self.disturbances = DisturbanceSchedule(self.batch)
        self._prior = None if self.start is None else given_prior(self.start)
        self._robust = params.robust and params.start is not Start.PAPER
        self._length_m = 0.25 * extent_m

    def initial(self, t_ns: int, T_ac: Pose, acquired: bool = False) -> Track:
        """The track before the first scan: the given start, else a body at rest at a pose.

        Args:
            t_ns: instant of the first scan [ns].
            T_ac: pose of {C} in {A}, used where no start is given.
            acquired: the pose was found by registration, which may leave directions undetermined.
        """
        if self.start is not None:
            return Track(
                self.start, "near", prior=self._prior, prior_ns=self.start.t_ns, started_ns=t_ns
            )
        belief = guessed_belief(t_ns, self.frame.pose_into(T_ac, t_ns), self.params)
        mode = "filter" if self.params.start is Start.PAPER else "start"
        unknown = common_motions(np.eye(6), np.eye(6) if acquired else None, self._length_m)
        return Track(
            belief,
            mode,
            started_ns=t_ns,
            undetermined=unknown,
            errors=ModelErrors(kept=mode != "filter"),
        )

    def resumed(self, belief: Belief) -> Track:
        """The track of a filter that goes on from a belief.

        Unlike a given start, the belief replaces all poses before it, however uncertain it is.

        Args:
            belief: in {A}.
        """
        return Track(self.frame.belief_into(belief), "filter", started_ns=belief.t_ns)

    def predict(self, track: Track, t_ns: int) -> Prediction:
        """The predicted mean and covariance at an instant (eq:KF_propagate).

        Args:
            track: after the last scan.
            t_ns: instant of the scan [ns].

        Raises:
            UsageError: the instant is too far from the last scan to predict the rotation.
        """
        belief, Phi = self.batch.predicted(track, t_ns)
        return Prediction(
            belief, Phi, measurement_jacobian(belief.x), track.window, counted=track.errors.counted
        )

    def determined(
        self, track: Track, prediction: Prediction, alignment: Alignment
    ) -> tuple[Track, Prediction]:
        """The track before a scan and its prediction, turned if its pose first determines a
        rotation of the model.

        Args:
            track: after the last scan.
            prediction: of this scan.
            alignment: of this scan.
        """
        if not track.undetermined.size:
            return track, prediction
        t_ns = prediction.belief.t_ns
        T_ac = self.frame.pose_into(alignment.T_ac, t_ns)
        after = turned(track, prediction.belief.x.T_ac, T_ac, alignment)
        return (track, prediction) if after is track else (after, self.predict(after, t_ns))

    def innovate(self, prediction: Prediction, alignment: Alignment) -> Innovation:
        """The innovation of a registered pose: alpha, S, R, NIS and the Cauchy weight of the pose
        in the update.

        Args:
            prediction: of this scan.
            alignment: a measured pose.
        """
        x, alignment = (
            prediction.belief.x,
            self.frame.alignment_into(alignment, prediction.belief.t_ns),
        )
        R, dof = self.noise.of(alignment, x, prediction.window), self.noise.dof(alignment)
        alpha, share = (
            innovation_vector(x, alignment.T_ac),
            self.noise.correlated_share(alignment, prediction.counted),
        )
        more = share, dof, alignment.rms_m, alignment.free
        return innovation_of(prediction.belief.P, prediction.H, alpha, R, self._robust, *more)

    def step(
        self,
        track: Track,
        prediction: Prediction,
        innovation: Innovation | None,
        admission: Admission,
        converged: bool,
    ) -> tuple[Track, Finding]:
        """The posterior, and what was found of the pose. The cause of a large innovation is decided
        with the next scans.

        Args:
            track: after the last scan.
            prediction: of this scan.
            innovation: None where the scan gave no pose.
            admission: by the rules on this scan alone.
            converged: t_1 was reached at the last scan.

        Returns:
            The track and the finding.
        """
        if innovation is None:
            return self.update(track, prediction, None, 0), Finding.UNTESTED
        epoch = Epoch(
            track.changed(recent=(), doubtful=(), previous=None), prediction, innovation, converged
        )
        admitted = int(admission is Admission.ADMITTED)
        after, finding = self.anomalies.step(
            track,
            epoch,
            admission,
            lambda t: self.update(t, prediction, innovation, admitted, converged),
        )
        after = after.changed(
            undetermined=undetermined(track, innovation, finding.used, self._length_m)
        )
        if not finding.used:
            return after, finding
        after = self.anomalies.with_possible_change(after)
        if self._robust and after.mode in ("fit", "filter"):
            after = self.disturbances.tested(after)
        return self.batch.resolved(after), finding

    def track_forecast(self, track: Track, times_s: Array, grasp_c: Array = ZERO) -> Forecast:
        """Predicted 1 sigma of the grasp point after a scan, by components where the likelihood is
        not Gaussian.

        Args:
            track: after the scan.
            times_s: (n,) >= 0, ascending [s after the scan].
            grasp_c: (3,) grasp point in {C} [m].
        """
        noise, b = self.batch.noise_levels(track), common_1s(track, self.frame)
        if track.mode != "fit" or track.batch is None or len(track.batch.components) < 2:
            belief = at_grasp(self.frame.belief_out(track.belief), grasp_c)
            found = driven_forecast(belief, times_s, *noise)
        else:
            x, y, z = (np.asarray(self.frame.origin_c) + grasp_c).tolist()
            found = mixture_forecast(
                track.batch.components, track.belief.t_ns, times_s, *noise, (x, y, z)
            )
        move, turn = float(np.linalg.norm(b)), 0.0
        if (motions := self._common_motions(track)).size:
            turns, moves = map(np.linalg.norm, np.split(self.frame.motions_out(motions), 2))
            move = math.hypot(move, float(moves), float(np.linalg.norm(grasp_c)) * float(turns))
            turn = float(turns)
        return Forecast(
            found.times_s,
            np.hypot(found.pos_1s_m, move),
            found.vel_1s_mps,
            np.minimum(np.hypot(found.rot_1s_rad, turn), 2.0 * ANY_HALF_RAD),
            (move, turn),
        )

    def gramian_rows(
        self,
        track: Track,
        prediction: Prediction,
        innovation: Innovation | None,
        last: FittedMotion | None,
    ) -> GramianRows:
        """What a scan gives to the observability Gramian, which follows the motion of the last fit:
        the mean of a mixture between two fits follows no motion of the body.

        A new fit is another motion, along which the Gramian begins anew with all its poses. The
        filter, and a fit that begins with a manoeuvre, continue it by their own predictions.

        Args:
            track: after the scan.
            prediction: of the scan.
            innovation: of the scan; None where it was not used.
            last: motion of the fit that was followed until now; None before a fit.
        """
        fitted, filters = track.batch, track.mode == "filter"
        if fitted is not None and (last is None or not last.is_of(fitted)):
            last = FittedMotion.of(fitted)
            if not filters or 0 < len(track.fixes) < self.params.audit_poses:
                motion, Phi = last.at(track.belief.t_ns, self.batch.orbit)
                return GramianRows(motion, True, Phi, *rows_along(last, track.fixes))
        if last is None or fitted is None or fitted.points is None or filters:
            R = None if innovation is None else self.noise.base(innovation.R, prediction.window)
            return GramianRows(last, False, prediction.Phi, prediction.H, R)
        motion, Phi = last.at(prediction.belief.t_ns, self.batch.orbit)
        pose = track.fixes[-1]
        R = None if innovation is None else in_camera(pose.C, pose.T_ac.q, motion.x.q_bc)
        return GramianRows(motion, False, Phi, measurement_jacobian(motion.x), R)

    def residual_after(
        self, track: Track, prediction: Prediction, innovation: Innovation
    ) -> tuple[bool, Array, Array, Array, Array, float] | None:
        """What ``monitor.convergence.violations`` tests after the belief, in its order; None before
        a fit.

        Args:
            track: after a healthy scan.
            prediction: of that scan.
            innovation: of that scan.
        """
        if track.mode not in ("fit", "filter"):
            return None
        if (
            prediction.lag_s or prediction.blur is not None
        ):  # the pose belongs to the mean instant of its points
            fix, scaled = (
                self.batch.fix(prediction, innovation),
                NoiseWindow.empty(prediction.window.rise),
            )
            belief, _ = propagated(track.belief, fix.t_ns, 0.0, 0.0, self.batch.orbit)
            left, R = (
                innovation_vector(belief.x, fix.T_ac),
                in_camera(fix.C, fix.T_ac.q, belief.x.q_bc),
            )
        else:
            belief, R, scaled = track.belief, innovation.R, prediction.window
            left = residual(belief.x, prediction.belief.x, innovation.alpha)
        rise = (track.recent[-1].prediction if track.recent else prediction).window.rise
        window = track.window if track.window.rise is rise else replace(track.window, rise=rise)
        R = self.noise.rescaled(R, scaled, window)
        C, inflation = (
            self.pose_covariance(belief),
            NO_INFLATION if track.inflation is None else track.inflation,
        )
        return (
            semidefinite(track.belief.P),
            C,
            left,
            R,
            inflation,
            gate_of(innovation.dof, R, R + C),
        )

    def _common_motions(self, track: Track) -> Array:
        motions = track.errors.motions
        return (
            np.hstack([track.undetermined, self.frame.motions_into(motions)])
            if motions.size
            else track.undetermined
        )

    def _replayed(self, track: Track, epoch: Epoch) -> tuple[Track, Epoch]:
        """A stored scan, predicted and used again from another track: the track after it, and
        the scan as used.
        """
        old, prediction = epoch.prediction, self.predict(track, epoch.prediction.belief.t_ns)
        prediction = replace(prediction, lag_s=old.lag_s, blur=old.blur)
        seen, R = (
            epoch.innovation,
            self.noise.rescaled(epoch.innovation.R, old.window, track.window),
        )
        alpha = innovation_vector(prediction.belief.x, measured_pose(old.belief.x, seen.alpha))
        more = seen.share, seen.dof, seen.rms_m
        innovation = innovation_of(prediction.belief.P, prediction.H, alpha, R, self._robust, *more)
        used = Epoch(
            track.changed(recent=(), doubtful=(), previous=None),
            prediction,
            innovation,
            epoch.converged,
        )
        return self.update(track, prediction, innovation, 1, epoch.converged), used

    def update(
        self,
        track: Track,
        prediction: Prediction,
        innovation: Innovation | None,
        gamma: int,
        converged: bool = True,
    ) -> Track:
        """The posterior. With gamma 0 or no innovation it equals the prior exactly.

        Args:
            track: after the last scan.
            prediction: of this scan.
            innovation: None where the scan gave no pose.
            gamma: 1 for a healthy scan, 0 for a faulty one.
            converged: t_1 was reached at the last scan. A fit hands over to the filter only then.
        """
        if innovation is None or gamma == 0:
            return track.changed(
                belief=prediction.belief,
                change_P=prediction.Phi @ track.change_P @ prediction.Phi.T,
            )
        if track.mode in ("start", "fit") or (track.mode == "near" and not self.params.by_gain):
            after = self.batch.initialised(track, prediction, innovation, converged)
        else:
            after = self.batch.checked(self.batch.filtered(track, prediction, innovation))
        return self.batch.resolved(after)

    def disturbances_of(self, track: Track) -> tuple[float, float] | None:
        """Root densities of the random torque [rad/s^1.5] and force [m/s^1.5] in use.

        Args:
            track: after a scan.
        """
        torque, force = self.batch.noise_levels(track)
        return torque, force

    def published(self, track: Track) -> Belief:
        """The belief in {A} with errors that the filter does not carry.

        Later poses do not reduce errors that all poses may have in common, nor motions of the model
        that no scan determines (bodies of revolution). They decide on a change of the velocities
        that the last scans make possible.

        Args:
            track: after a scan.
        """
        belief, b, motions = track.belief, common_1s(track, self.frame), self._common_motions(track)
        P = belief.P + track.change_P
        P[RHO, RHO] += b[:, None] * b
        P = P + motion_covariance(motions, belief.x.q_bc) if motions.size else P
        return self.frame.belief_out(replace(belief, P=P))

    def motion(self, belief: Belief) -> Trajectory:
        """The predicted path of the grasp point without disturbances.

        Args:
            belief: mean and covariance now, in {A}; only the mean is used.

        Returns:
            Function of times (n,) >= 0 [s after the belief's instant]: positions (n, 3) [m] and
            velocities (n, 3) [m/s] in {A}. It raises ValueError for a time that is negative or not
            finite.
        """
        orbit = self.batch.orbit
        path = dynamics.grasp_trajectory(
            belief.x, None if orbit is None else orbit.at(belief.t_ns), drive_in(belief)
        )
        path = accelerated(path, belief.u[3:]) if isinstance(belief, DrivenBelief) else path
        return accelerated(path, self.frame.acceleration) if self.frame.falls else path

    def attitude(self, belief: Belief) -> Callable[[Array], Array]:
        """The predicted attitudes of the fixture without disturbances.

        Args:
            belief: mean and covariance now; only the mean is used.

        Returns:
            Function of times (n,) [s after the belief's instant]: attitudes q_ac (n, 4).
        """
        return dynamics.fixture_attitude(belief.x, drive_in(belief))

    def forecast(self, belief: Belief, times_s: Array) -> Forecast:
        """Predicted 1 sigma of the grasp point.

        Args:
            belief: mean and covariance now.
            times_s: (n,) >= 0, ascending [s after the belief's instant].
        """
        return driven_forecast(
            belief, times_s, *(given or 0.0 for given in self.params.disturbances)
        )

    def pose_covariance(self, belief: Belief) -> Array:
        """Covariance (6, 6) of the pose of {C}, H P H' (eq:innovation): position in {A} [m], half
        angles in {B} [rad].

        Args:
            belief: mean and covariance.
        """
        return _motion.pose_covariance(belief.P, measurement_jacobian(belief.x))
