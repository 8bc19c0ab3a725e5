"""KISS-ICP (Vizzo et al., RA-L 2023) as a front end, with motion scaled to the real sweep.

The parts are the kiss_icp package's own: preprocessing, voxel map, adaptive threshold, registration.
What is ours is how they are driven:

- the constant-velocity model knows time, so a lost scan or an uneven rate doesn't break the prediction,
  and a sweep is deskewed by its own duration (a sensor cropped to 120 degrees takes a third of its
  period; KISS-ICP would spread the whole period's motion over it);
- the first two scans are registered twice, for the motion and then deskewed by it;
- motions that the model did not predict are checked (`motion_check`); where a scan fits nothing that was
  seen before, a new map begins, and its relation to the former one is left open;
- the local map forgets what was seen long ago, and not only what is far away (`recent_map`);
- each answer is refined against surfaces, which yields its covariance (`surface_refinement`), but for what
  the prediction's miss tells of it (`uncertainty`).
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.config.config import (
    AdaptiveThresholdConfig,
    DataConfig,
    MappingConfig,
    RegistrationConfig,
)
from kiss_icp.kiss_icp import KissICP
from kiss_icp.mapping import get_voxel_hash_map
from numpy.typing import NDArray

from lifelong_slam.geometry import exp, invert, log, transform
from lifelong_slam.odometry.motion_check import MotionCheck
from lifelong_slam.odometry.odometry import OdometryEstimate, Tracking
from lifelong_slam.odometry.recent_map import RecentMap
from lifelong_slam.odometry.surface_refinement import SurfaceRefinement
from lifelong_slam.odometry.uncertainty import (
    RegistrationNoise,
    distortion_bias,
    extrapolation_covariance,
)
from lifelong_slam.registration import Cloud
from lifelong_slam.scan import NANOSECONDS, Scan

Array = NDArray[np.float64]
logger = logging.getLogger(__name__)

_GAP = 3.0  # usual periods without a scan, after which the velocity says little
_GLANCE = 20_000  # points; ICP thins them to some thousand anyway
_MIN_POINTS = 50  # in range; fewer say less than the prediction does


@dataclass(frozen=True, slots=True)
class _Fit:
    """A scan that was deskewed by a velocity (6,), and the pose that fits it."""

    T_odom_sensor: Array
    covariance: Array
    known: float  # share of the points on surfaces of the map
    velocity: Array
    points: Array
    downsampled: Array
    cloud: Cloud


class KissIcpOdometry:
    """Scan-to-map odometry; see the module's text for what differs from the bare package."""

    def __init__(
        self,
        voxel_size: float,
        min_range: float,
        max_range: float,
        max_points_per_voxel: int = 20,
        convergence_criterion: float = 1e-2,
    ) -> None:
        """Set up.

        Args:
            voxel_size: of the local map, metres.
            min_range: points nearer than this are dropped, metres.
            max_range: points further away are dropped, metres.
            max_points_per_voxel: density of the local map.
            convergence_criterion: norm of the last step at which ICP stops; KISS-ICP's own 1e-4 is
                spent better on the refinement that follows.
        """
        config = KISSConfig(
            data=DataConfig(min_range=min_range, max_range=max_range, deskew=True),
            mapping=MappingConfig(voxel_size=voxel_size, max_points_per_voxel=max_points_per_voxel),
            registration=RegistrationConfig(
                # One thread: TBB's sums depend on scheduling, and runs must repeat to the digit.
                max_num_threads=1,
                convergence_criterion=convergence_criterion,
            ),
            adaptive_threshold=AdaptiveThresholdConfig(),
        )
        self._kiss = KissICP(config)
        self._new_map = partial(get_voxel_hash_map, config)
        self._voxel_size = voxel_size
        self._map = RecentMap(self._new_map)
        self._check = MotionCheck(voxel_size)
        self._refinement = SurfaceRefinement(voxel_size)
        self._noise = RegistrationNoise()
        self._velocity: Array = np.zeros(6)  # tangent of T_last_next a second
        self._last: OdometryEstimate | None = None  # what the next scan is registered from
        self._first_scan: Scan | None = None  # of a map, until the second has come
        self._is_lost = True  # no map has been begun that scans fit into
        self._registered_at: int | None = None  # stamp of the newest that was; of the first before
        self._period = 0.0
        self._checks = 0
        self._refused = 0  # refinements in the maps before this one

    @property
    def counts(self) -> Mapping[str, int]:
        """What has happened so far, by name."""
        return {
            "motions_checked": self._checks,
            "refinements_refused": self._refused + self._refinement.refused,
        }

    def register(self, scan: Scan) -> OdometryEstimate:
        """Estimate the pose of a cleaned scan that is newer than all before it."""
        estimate = self._estimate(scan)
        if self._is_lost and estimate.tracking is Tracking.REGISTERED:
            self._is_lost = False
            return replace(estimate, tracking=Tracking.STARTED)
        return estimate

    def _estimate(self, scan: Scan) -> OdometryEstimate:
        glance = self._glance(scan)
        if len(glance) < _MIN_POINTS:
            return self._predict(scan)
        if self._last is None:
            self._first_scan = scan
            self._last = self._begin_map(scan, np.eye(4))
            return self._last
        if self._first_scan is not None:
            return self._start(self._first_scan, scan, self._last)
        return self._track(scan, glance, self._last)

    def _predict(self, scan: Scan) -> OdometryEstimate:
        """Extrapolate to a scan that can't be registered; the next is registered from the last that was."""
        T: Array = np.eye(4)
        if self._registered_at is None:
            self._registered_at = scan.middle_stamp
        covariance = extrapolation_covariance(
            (scan.middle_stamp - self._registered_at) / NANOSECONDS
        )
        if self._last is not None:
            interval = (scan.middle_stamp - self._last.stamp) / NANOSECONDS
            T = self._last.T_odom_sensor @ exp(self._velocity * interval)
            covariance += self._last.covariance
        points = self._deskew(scan)
        cloud = Cloud.prepare(points, self._voxel_size)
        stamp = scan.middle_stamp
        return OdometryEstimate(stamp, T, covariance, points, cloud, Tracking.PREDICTED)

    def _track(self, scan: Scan, glance: Array, last: OdometryEstimate) -> OdometryEstimate:
        """Predict, register a glance at the scan, check, then deskew, refine and enter all of it."""
        interval = (scan.middle_stamp - last.stamp) / NANOSECONDS
        predicted = last.T_odom_sensor @ exp(self._velocity * interval)
        by_points = self._icp(glance, predicted)
        guess: Array | None = by_points
        gap = self._is_gap(interval)
        checked = gap or self._check.is_suspicious(predicted, by_points)
        if checked:
            guess = self._resolve(glance, last, [by_points, predicted])
        fit = None if guess is None else self._fit(scan, guess, last)
        if fit is not None and self._check.shows_something_new(fit.known) and not checked:
            guess = self._resolve(glance, last, [fit.T_odom_sensor, predicted])
            if guess is not None and self._check.is_suspicious(fit.T_odom_sensor, guess):
                fit = self._fit(scan, guess, last)
        if guess is None:
            return self._lose(scan)
        if fit is None:
            return self._predict(scan)
        T = fit.T_odom_sensor
        self._insert(fit.downsampled, fit.cloud, T)
        deviation = invert(predicted) @ T
        self._kiss.adaptive_threshold.update_model_deviation(deviation)
        xi = log(deviation)
        self._noise.update(None if gap else xi)
        # Where it accelerates steadily, the mean velocity of above lags by what the prediction missed.
        bias = distortion_bias(fit.cloud, scan, fit.velocity, xi / interval)
        self._velocity = log(invert(last.T_odom_sensor) @ T) / interval
        covariance = fit.covariance + self._noise.covariance + np.outer(bias, bias)
        self._registered_at = scan.middle_stamp
        self._last = OdometryEstimate(scan.middle_stamp, T, covariance, fit.points, fit.cloud)
        return self._last

    def _icp(self, points: Array, guess: Array) -> Array:
        """Register points to the local map from a guess, as KISS-ICP does."""
        source, _ = self._kiss.voxelize(points)
        sigma = self._kiss.adaptive_threshold.get_threshold()
        return np.asarray(
            self._kiss.registration.align_points_to_map(
                points=source,
                voxel_map=self._map.current,
                initial_guess=guess,
                max_correspondance_distance=3 * sigma,
                kernel=sigma,
            )
        )

    def _resolve(
        self, glance: Array, last: OdometryEstimate, guesses: Sequence[Array]
    ) -> Array | None:
        self._checks += 1
        return self._check.resolve(glance, last.T_odom_sensor, guesses)

    def _fit(self, scan: Scan, guess: Array, last: OdometryEstimate) -> "_Fit | None":
        """Deskew a scan by what its guessed pose says, and refine that; None if it fits too little.

        The velocity is the mean of the old and the new one: the old one lags behind, the new one would feed
        each registration's noise into the next.
        """
        interval = (scan.middle_stamp - last.stamp) / NANOSECONDS
        velocity = (self._velocity + log(invert(last.T_odom_sensor) @ guess) / interval) / 2
        points = self._deskew(scan, velocity)
        downsampled, cloud = self._thinned(points)
        refined = self._refinement.refine(cloud, guess)
        if refined is None:
            return None
        T, covariance, known = refined.T_odom_sensor, refined.covariance, refined.known
        return _Fit(T, covariance, known, velocity, points, downsampled, cloud)

    def _insert(self, downsampled: Array, cloud: Cloud, T: Array) -> None:
        self._refinement.insert(cloud, T)
        self._map.update(downsampled, T)
        self._check.remember(downsampled, T)

    def _thinned(self, points: Array) -> tuple[Array, Cloud]:
        _, downsampled = self._kiss.voxelize(points)
        return downsampled, Cloud.prepare(downsampled, self._voxel_size)

    def _begin_map(self, scan: Scan, T: Array) -> OdometryEstimate:
        """Forget what was seen before, and begin with a scan at a (4, 4) pose, which has no error."""
        self._refused += self._refinement.refused
        self._map = RecentMap(self._new_map)
        self._check = MotionCheck(self._voxel_size)
        self._refinement = SurfaceRefinement(self._voxel_size)
        points = self._deskew(scan)
        downsampled, cloud = self._thinned(points)
        self._insert(downsampled, cloud, T)
        self._registered_at = scan.middle_stamp
        return OdometryEstimate(scan.middle_stamp, T, np.zeros((6, 6)), points, cloud)

    def _start(self, first: Scan, second: Scan, last: OdometryEstimate) -> OdometryEstimate:
        """Begin a map with two scans, if they fit together; else the second one waits for a third."""
        velocity = self._first_velocity(first, second)
        if velocity is None:
            return self._lose(second)
        logger.info("starting at %.1f m/s", np.linalg.norm(velocity[3:]))
        self._velocity = velocity
        self._first_scan = None
        self._last = self._begin_map(first, last.T_odom_sensor)
        return self._track(second, self._glance(second), self._last)

    def _first_velocity(self, first: Scan, second: Scan) -> Array | None:
        """Return the (6,) velocity between the first two scans of a map; None if they don't fit."""
        interval = (second.middle_stamp - first.middle_stamp) / NANOSECONDS
        velocity = self._velocity
        for _ in range(
            2
        ):  # as recorded, then freed of the distortion that the first answer implies
            motion = self._check.first_motion(
                self._deskew(first, velocity), self._deskew(second, velocity)
            )
            if motion is None:
                return None
            velocity = log(motion) / interval
        return velocity

    def _lose(self, scan: Scan) -> OdometryEstimate:
        """Give up the map for one that begins with this scan, if the next one fits it."""
        self._is_lost = True
        self._first_scan = scan
        self._last = self._predict(scan)
        return self._last

    def _glance(self, scan: Scan) -> Array:
        """Deskew a scan's every n-th point by the old velocity: as many as ICP has a use for."""
        stride = max(1, len(scan.points) // _GLANCE)
        offsets = None if scan.offsets is None else scan.offsets[::stride]
        return self._deskew(Scan(scan.stamp, scan.points[::stride], offsets))

    def _deskew(self, scan: Scan, velocity: Array | None = None) -> Array:
        """Crop a scan to range and move its points to the sensor's frame at the sweep's middle.

        Args:
            scan: as recorded.
            velocity: (6,) to deskew by, if not the current one.
        """
        if scan.offsets is None or scan.duration == 0:
            return self._crop(scan.points, np.zeros(0), np.eye(4))
        motion = (self._velocity if velocity is None else velocity) * scan.duration
        at_end = self._crop(scan.points, scan.offsets, exp(motion))
        return transform(exp(motion / 2), at_end)

    def _crop(self, points: Array, offsets: Array, motion: Array) -> Array:
        return np.asarray(self._kiss.preprocessor.preprocess(points, offsets, motion))

    def _is_gap(self, interval: float) -> bool:
        """Tell whether scans are missing, and learn the usual period."""
        gap = self._period > 0 and interval > _GAP * self._period
        self._period = interval if self._period == 0 else 0.9 * self._period + 0.1 * interval
        return gap
