"""Trajectories for the tests of eval."""

import numpy as np
from evo.core.trajectory import PoseTrajectory3D
from scipy.spatial.transform import Rotation

from eval.evidence import Evidence


def make(positions, rotations=None, stamps=None):
    positions = np.asarray(positions, dtype=float)
    rotations = Rotation.identity(len(positions)) if rotations is None else rotations
    stamps = np.arange(len(positions)) * 0.1 if stamps is None else np.asarray(stamps, dtype=float)
    return PoseTrajectory3D(positions, np.roll(rotations.as_quat(), 1, axis=1), stamps)


def winding(count=400, rate=10.0, seed=0):
    """A drive of about 10 m/s around bends and over hills."""
    rng = np.random.default_rng(seed)
    stamps = np.arange(count) / rate
    yaw = np.cumsum(rng.normal(size=count)) * 0.02 + 0.3 * np.sin(stamps / 3)
    steps = np.column_stack([np.cos(yaw), np.sin(yaw), 0.05 * np.sin(stamps / 5)]) * 10 / rate
    rotations = Rotation.from_euler("zyx", np.column_stack([yaw, 0.02 * yaw, 0.01 * yaw]))
    return make(np.cumsum(steps, axis=0), rotations, stamps)


def disturbed(reference, seed=1, size=0.1):
    """The reference with noise, seen from another frame."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(reference.num_poses, 3)) * size
    turn = Rotation.from_rotvec([0.1, -0.2, 1.0])
    quaternions = np.roll(reference.orientations_quat_wxyz, -1, axis=1)
    wobble = Rotation.from_rotvec(rng.normal(size=(reference.num_poses, 3)) * 0.01)
    rotations = turn * Rotation.from_quat(quaternions) * wobble
    moved = turn.apply(reference.positions_xyz + noise) + np.array([5.0, -3.0, 2.0])
    return make(moved, rotations, reference.timestamps)


def values_of(metric, **evidence):
    """What a metric says, which must be what it promises to say."""
    values = metric.measure(Evidence(**evidence)).values
    assert set(values) == set(metric.keys)
    return values
