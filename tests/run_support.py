"""What the tests of runs share: a room seen from a moving sensor, as scans, files and sources."""

import signal
from pathlib import Path

import numpy as np

from lifelong_slam.geometry import exp, invert, transform
from lifelong_slam.scan import Scan
from lifelong_slam.trajectory import Trajectory

PERIOD = 100_000_000
START = 1_700_000_000_000_000_000


def room(seed=0, size=30.0, boxes=40, points=60_000):
    """Return (N, 3) points on walls, floor and boxes of random size, sensor height at z = 0."""
    rng = np.random.default_rng(seed)
    centres = np.vstack([[0.0, 0.0], rng.uniform(-size, size, (boxes, 2))])
    halves = np.vstack([[size, size], rng.uniform(0.3, 2.0, (boxes, 2))])
    heights = np.concatenate([[6.0], rng.uniform(0.5, 5.0, boxes)])
    near = np.linalg.norm(centres, axis=1) > 6.0
    near[0] = True
    which = rng.choice(np.flatnonzero(near), points)
    side, along = rng.choice([-1.0, 1.0], points), rng.uniform(-1.0, 1.0, points)
    x_wall = rng.random(points) < 0.5
    unit = np.where(x_wall[:, None], np.c_[side, along], np.c_[along, side])
    walls = np.c_[centres[which] + unit * halves[which], rng.random(points) * heights[which] - 1.5]
    floor = np.c_[rng.uniform(-size, size, (points // 3, 2)), np.full(points // 3, -1.5)]
    return np.vstack([walls, floor])


def arc(count, step=0.2, turn=0.02):
    """Return (count, 4, 4) poses that move `step` metres and turn `turn` radians each."""
    motion = exp(np.array([0.0, 0.0, turn, step, 0.0, 0.0]))
    poses = [np.eye(4)]
    for _ in range(count - 1):
        poses.append(poses[-1] @ motion)
    return np.array(poses)


def see(world, pose, visible=6000, max_range=40.0, rng=None):
    """Return about `visible` random world points within range, in the sensor's frame."""
    rng = rng or np.random.default_rng(0)
    near = np.abs(world[:, :2] - pose[:2, 3]).max(axis=1) < max_range
    chosen = rng.choice(np.flatnonzero(near), visible)
    points = transform(invert(pose), world[chosen])
    return points[np.linalg.norm(points, axis=1) < max_range]


def scans(count, offsets=None, world=None, poses=None, **view):
    """Return scans of a room along an arc; `offsets` are the same for each scan."""
    world, rng = room() if world is None else world, np.random.default_rng(1)
    clouds = [
        see(world, pose, rng=rng, **view) for pose in (arc(count) if poses is None else poses)
    ]
    times = [None if offsets is None else np.resize(offsets, len(points)) for points in clouds]
    return [Scan(START + i * PERIOD, clouds[i], times[i]) for i in range(len(clouds))]


def write_folder(path, count):
    """Write scans as numbered .bin files."""
    path.mkdir(parents=True)
    for i, scan in enumerate(scans(count)):
        rows = np.zeros((len(scan.points), 4), np.float32)
        rows[:, :3] = scan.points
        rows.tofile(path / f"{i:06d}.bin")
    return path


class ListSource:
    """Yields the scans that it was given."""

    T_base_sensor = np.eye(4)

    def __init__(self, scans):
        self.scans = scans

    def __len__(self):
        return len(self.scans)

    def __iter__(self):
        yield from self.scans

    def reference(self):
        return None


class SignallingSource(ListSource):
    """Sends its own process a signal before some of its scans, as an impatient user does."""

    def __init__(self, count: int, at: list[int], number: int = signal.SIGINT):
        super().__init__(scans(count))
        self.at = at
        self.number = number

    def __iter__(self):
        for i, scan in enumerate(self.scans):
            if i in self.at:
                signal.raise_signal(self.number)
            yield scan


class SurveyedSource(ListSource):
    """Knows the room that its scans see, and the path through it."""

    def __init__(self, count: int, surface: str):
        super().__init__(scans(count))
        self.surface_path = Path(surface)
        stamps = np.array([scan.stamp for scan in self.scans])
        self.path = Trajectory(stamps, arc(count))

    def reference(self):
        return self.path
