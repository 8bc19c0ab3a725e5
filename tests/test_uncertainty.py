"""What the prediction's miss tells about the errors of odometry."""

import numpy as np
import pytest
from slam_support import PERIOD, Lidar, drive, planar, seconds, town

from lifelong_slam.geometry import exp, invert, log
from lifelong_slam.odometry.kiss_icp import KissIcpOdometry
from lifelong_slam.odometry.uncertainty import RegistrationNoise, distortion_bias
from lifelong_slam.registration import Cloud, refine
from lifelong_slam.scan import Scan

SIGMAS = np.array([1, 2, 3, 10, 20, 30]) * 1e-3
VOXEL = 0.5
HEIGHT = 1.8
FORWARD = Lidar(width=2.1, columns=300, rings=32, noise=0.005)


def noise_of(poses):
    """Return the mean of the noise that is learnt from (N, 6) tangent poses at an even rate."""
    noise, history = RegistrationNoise(), []
    for deviation in np.diff(poses, n=2, axis=0):
        noise.update(deviation)
        history.append(noise.covariance)
    return np.mean(history[100:], axis=0)


@pytest.mark.parametrize("sway", [0.0, 20.0])
def test_noise_is_told_from_a_motion_that_predictions_miss(sway):
    t = np.arange(2000) * PERIOD
    motion = sway * SIGMAS * np.sin(2 * np.pi * t / 2.0)[:, None]  # a car's body, once in 2 s
    noise = np.random.default_rng(0).normal(scale=SIGMAS, size=(len(t), 6))
    learnt = noise_of(motion + noise) / np.outer(SIGMAS, SIGMAS)
    np.testing.assert_allclose(np.diag(learnt), 1, atol=0.4)
    deviations = np.diff(motion, n=2, axis=0)
    assert sway == 0 or np.all(np.var(deviations, axis=0) > 1.5 * SIGMAS**2)


def test_constant_acceleration_is_no_noise():
    t = np.arange(200)[:, None]
    np.testing.assert_allclose(noise_of(t**2 * SIGMAS), 0, atol=1e-12)


def test_a_gap_teaches_nothing_about_noise():
    noise = RegistrationNoise()
    for deviation in (SIGMAS, None, 50 * SIGMAS, 50 * SIGMAS):
        noise.update(deviation)
    np.testing.assert_array_equal(noise.covariance, np.zeros((6, 6)))


def forward_town(seed):
    return town(seed, road=lambda xy: np.abs(xy[:, 1]) < 5)


def deskewed(scan, velocity):
    """Move a sweep's points to its middle, taking it for one of constant velocity (6,)."""
    times = scan.offsets - scan.duration / 2
    poses = exp(times[:, None] * velocity)
    return np.einsum("nij,nj->ni", poses[:, :3, :3], scan.points) + poses[:, :3, 3]


def error_and_bias(seed, lag):
    """Return the (6,) error of registering a sweep that was deskewed wrongly, and the one foretold."""
    velocity = np.array([0, 0, 0.1, 6.0, 0, 0])
    begin, end = (planar(0, 0, 0, HEIGHT) @ exp(s * PERIOD / 2 * velocity) for s in (-1, 1))
    scan = FORWARD.sweep(forward_town(seed), begin, end, rng=np.random.default_rng(seed))
    target = Cloud.prepare(deskewed(scan, velocity), VOXEL)
    cloud = Cloud.prepare(deskewed(scan, velocity + lag), VOXEL)
    error = log(refine(target, cloud, np.eye(4), 2 * VOXEL).T_target_source)
    return error, -distortion_bias(cloud, scan, velocity + lag, lag)


@pytest.mark.parametrize("lag", [(2, 0.15), (3, 1.0), (4, 1.0)], ids=["yaw", "along", "across"])
def test_bias_is_what_a_registration_makes_of_a_wrong_velocity(lag):
    component, size = lag
    pairs = [error_and_bias(seed, size * np.eye(6)[component]) for seed in range(4)]
    errors, biases = np.array(pairs).swapaxes(0, 1) * ([15.0] * 3 + [1.0] * 3)  # as seen at 15 m
    agreement = np.sum(errors * biases) / np.sqrt(np.sum(errors**2) * np.sum(biases**2))
    assert agreement > 0.7
    assert 0.4 < np.linalg.norm(errors) / np.linalg.norm(biases) < 2


def test_a_scan_of_an_instant_has_no_distortion():
    points = np.random.default_rng(0).uniform(-10, 10, (500, 3))
    cloud = Cloud.prepare(points, VOXEL)
    for offsets in (None, np.full(500, 0.05)):
        bias = distortion_bias(cloud, Scan(0, points, offsets), np.ones(6), np.ones(6))
        np.testing.assert_array_equal(bias, np.zeros(6))


def turning_in(t):
    """Return the pose at a time of a car that turns into a bend after two seconds."""
    begin, ramp, rate, speed = 2.0, 0.6, 0.5, 5.0  # s, s, rad/s, m/s
    times = np.linspace(0, t, 400)
    yaw_rate = rate * np.clip((times - begin) / ramp, 0, 1)
    step = t / 399
    yaw = np.cumsum(yaw_rate) * step
    x, y = np.cumsum(np.cos(yaw)) * speed * step, np.cumsum(np.sin(yaw)) * speed * step
    return planar(x[-1] - 20, y[-1], yaw[-1], HEIGHT)


@pytest.mark.parametrize("seed", [0, 1])
def test_poses_at_the_onset_of_a_turn_are_as_uncertain_as_they_are_wrong(seed):
    scans = drive(forward_town(seed), FORWARD, turning_in, np.arange(28) * PERIOD)
    odometry = KissIcpOdometry(VOXEL, 1.0, 60.0)
    estimates = [odometry.register(scan) for scan in scans]
    truth = np.array([turning_in(seconds(e.stamp)) for e in estimates])
    before, turning = 12, slice(20, 27)  # the yaw rate grows from 2.0 to 2.6 s
    poses = np.array([e.T_odom_sensor for e in estimates])
    errors = log(invert(invert(truth[before]) @ truth) @ invert(poses[before]) @ poses)
    sigmas = np.sqrt([np.diag(e.covariance) for e in estimates])
    ratio = np.linalg.norm(errors[turning, 3:]) / np.linalg.norm(sigmas[turning, 3:])
    assert 0.5 < ratio < 2
    assert (
        np.linalg.norm(sigmas[before, 3:]) < 0.2 * np.linalg.norm(sigmas[turning, 3:], axis=1).max()
    )
