"""KISS-ICP (Vizzo et al., RA-L 2023) as a front end, with motion scaled to the real sweep.

The parts are the kiss_icp package's own: preprocessing, voxel map, adaptive threshold, registration.
What is ours is how they are driven:

- the constant-velocity model knows time, so a lost scan or an uneven rate doesn't break the prediction,
  and a sweep is deskewed by its own duration (a sensor cropped to 120 degrees takes a third of its
  period; KISS-ICP would spread the whole period's motion over it);
- the first two scans are registered twice, for the motion and then deskewed by it;
- motions that the model did not predict are checked (`motion_check`);
- the local map forgets what was seen long ago, and not only what is far away (`recent_map`);
- each answer is refined against surfaces, which yields its covariance (`surface_refinement`), but for what
  the prediction's miss tells of it (`uncertainty`).
"""

import logging
from dataclasses import replace
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
from lifelong_slam.odometry.odometry import OdometryEstimate
from lifelong_slam.odometry.recent_map import RecentMap
from lifelong_slam.odometry.surface_refinement import SurfaceRefinement
from lifelong_slam.odometry.uncertainty import RegistrationNoise, distortion_bias
from lifelong_slam.registration import Cloud
from lifelong_slam.scan import NANOSECONDS, Scan

Array = NDArray[np.float64]
logger = logging.getLogger(__name__)

_GAP = 3.0  # usual periods without a scan, after which the velocity says little
_GLANCE = 20_000  # points; ICP thins them to some thousand anyway
_MIN_POINTS = 50  # in range; fewer say less than the prediction does


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
        self._map = RecentMap(self._new_map)
        self._voxel_size = voxel_size
        self._check = MotionCheck(voxel_size)
        self._refinement = SurfaceRefinement(voxel_size)
        self._noise = RegistrationNoise()
        self._velocity: Array = np.zeros(6)  # tangent of T_last_next a second
        self._last: OdometryEstimate | None = None
        self._first_scan: Scan | None = None
        self._period = 0.0

    def register(self, scan: Scan) -> OdometryEstimate:
        """Estimate the pose of a cleaned scan that is newer than all before it."""
        glance = self._glance(scan)
        if len(glance) < _MIN_POINTS:
            return self._predict(scan, glance)
        if self._last is None:
            self._first_scan = scan
            self._last = self._enter(scan, self._deskew(scan), np.eye(4))
        else:
            if self._first_scan is not None:
                self._last = self._start_over(self._first_scan, scan)
                self._first_scan = None
                glance = self._glance(scan)
            self._last = self._track(scan, glance, self._last)
        return self._last

    def _predict(self, scan: Scan, points: Array) -> OdometryEstimate:
        """Go on as before for a scan that is next to empty; the next one is tracked from the last good."""
        T = np.eye(4)
        if self._last is not None:
            interval = (scan.middle_stamp - self._last.stamp) / NANOSECONDS
            T = self._last.T_odom_sensor @ exp(self._velocity * interval)
        cloud = Cloud.prepare(points, self._voxel_size)
        covariance = self._refinement.coarse_covariance
        return OdometryEstimate(scan.middle_stamp, T, covariance, points, cloud)

    def _track(self, scan: Scan, glance: Array, last: OdometryEstimate) -> OdometryEstimate:
        """Predict, register a glance at the scan, check, then deskew, refine and enter all of it."""
        interval = (scan.middle_stamp - last.stamp) / NANOSECONDS
        predicted = last.T_odom_sensor @ exp(self._velocity * interval)
        guess = self._icp(glance, predicted)
        gap = self._is_gap(interval)
        if gap or self._check.is_suspicious(predicted, guess):
            guess = self._check.resolve(glance, last.T_odom_sensor, [guess, predicted])
        # Deskew anew by the mean of the old and the new velocity: the old one lags behind, the new one
        # would feed each registration's noise into the next.
        self._velocity = (self._velocity + log(invert(last.T_odom_sensor) @ guess) / interval) / 2
        estimate = self._enter(scan, self._deskew(scan), guess)
        T = estimate.T_odom_sensor
        deviation = invert(predicted) @ T
        self._kiss.adaptive_threshold.update_model_deviation(deviation)
        xi = log(deviation)
        self._noise.update(None if gap else xi)
        # Where it accelerates steadily, the mean velocity of above lags by what the prediction missed.
        bias = distortion_bias(estimate.cloud, scan, self._velocity, xi / interval)
        self._velocity = log(invert(last.T_odom_sensor) @ T) / interval
        covariance = estimate.covariance + self._noise.covariance + np.outer(bias, bias)
        return replace(estimate, covariance=covariance)

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

    def _enter(self, scan: Scan, points: Array, guess: Array) -> OdometryEstimate:
        """Refine a registered scan's pose and enter the scan into the maps."""
        _, downsampled = self._kiss.voxelize(points)
        cloud = Cloud.prepare(downsampled, self._voxel_size)
        T, covariance = self._refinement.refine(cloud, guess)
        self._refinement.insert(cloud, T)
        self._map.update(downsampled, T)
        self._check.remember(downsampled, T)
        return OdometryEstimate(scan.middle_stamp, T, covariance, points, cloud)

    def _start_over(self, first: Scan, second: Scan) -> OdometryEstimate:
        """Find the motion between the first two scans, then enter the first one deskewed by it."""
        interval = (second.middle_stamp - first.middle_stamp) / NANOSECONDS
        for _ in range(
            2
        ):  # as recorded, then freed of the distortion that the first answer implies
            motion = self._check.first_motion(self._deskew(first), self._deskew(second))
            self._velocity = log(motion) / interval
        logger.info("starting at %.1f m/s", np.linalg.norm(self._velocity[3:]))
        self._map = RecentMap(self._new_map)
        self._check = MotionCheck(self._voxel_size)
        self._refinement = SurfaceRefinement(self._voxel_size)
        return self._enter(first, self._deskew(first), np.eye(4))

    def _glance(self, scan: Scan) -> Array:
        """Deskew a scan's every n-th point by the old velocity: as many as ICP has a use for."""
        stride = max(1, len(scan.points) // _GLANCE)
        offsets = None if scan.offsets is None else scan.offsets[::stride]
        return self._deskew(Scan(scan.stamp, scan.points[::stride], offsets))

    def _deskew(self, scan: Scan) -> Array:
        """Crop a scan to range and move its points to the sensor's frame at the sweep's middle."""
        if scan.offsets is None or scan.duration == 0:
            return self._crop(scan.points, np.zeros(0), np.eye(4))
        at_end = self._crop(scan.points, scan.offsets, exp(self._velocity * scan.duration))
        return transform(exp(self._velocity * scan.duration / 2), at_end)

    def _crop(self, points: Array, offsets: Array, motion: Array) -> Array:
        return np.asarray(self._kiss.preprocessor.preprocess(points, offsets, motion))

    def _is_gap(self, interval: float) -> bool:
        """Tell whether scans are missing, and learn the usual period."""
        gap = self._period > 0 and interval > _GAP * self._period
        self._period = interval if self._period == 0 else 0.9 * self._period + 0.1 * interval
        return gap
