"""What the tests of sessions in a map file share: drives on one circle that begin anywhere on it."""

from dataclasses import dataclass
from typing import Any

import networkx
import numpy as np
from slam_support import START, Lidar, Scan, town
from test_slam import RADIUS, VOXEL, DriftingOdometry, on_the_circle, pipeline

from lifelong_slam.geometry import invert
from lifelong_slam.mapping.session import MapSession
from lifelong_slam.scan import NANOSECONDS

SETTINGS = {
    "sensor": "toy",
    "T_base_sensor": np.diag([1.0, -1.0, -1.0, 1.0]),
    "voxel_size": VOXEL,
    "source": "circle",
    "config": "seed: 1\n",
}
SESSION_GAP = 1000 * NANOSECONDS  # between the beginnings of sessions
WINDOW = {"window": 10, "settle_every": 5}


@dataclass(frozen=True)
class Drive:
    """Scans and the true (N, 4, 4) T_world_sensor; odometry begins at the identity."""

    scans: list[Scan]
    truth: Any
    number: int

    @property
    def stamps(self):
        return np.array([scan.end_stamp for scan in self.scans])

    def odometry(self):
        return DriftingOdometry(invert(self.truth[0]) @ self.truth, seed=self.number)


def circle_town(seed):
    """Return a town whose road is the circle of `on_the_circle`."""
    return town(seed, 45, lambda xy: np.abs(np.linalg.norm(xy, axis=1) - RADIUS) < 4, spacing=7.0)


def record_drive(world, first, count, number):
    """Return `count` scans from the `first` place on the circle on; `number` sets noise and clock."""
    lidar, rng = Lidar(columns=60, duration=0.0, reach=40.0), np.random.default_rng(number)
    poses = np.array([on_the_circle(first + i) for i in range(count)])
    start = START + number * SESSION_GAP
    scans = [
        Scan(start + i * NANOSECONDS // 10, lidar.sweep(world, T, T, rng=rng).points)
        for i, T in enumerate(poses)
    ]
    return Drive(scans, poses, number)


def open_session(path, mode="map", **changes):
    return MapSession.open(path, mode, **SETTINGS | changes)


def run_session(path, drive, mode="map"):
    """Run a session to its end; return its result."""
    slam = pipeline(drive.odometry(), **WINDOW)
    with open_session(path, mode) as session:
        slam.begin(session)
        for scan in drive.scans:
            slam.process(scan)
        return slam.finish()


def cut_off(path, drive):
    """Run a session that ends without a word after its last scan."""
    slam = pipeline(drive.odometry(), **WINDOW)
    with open_session(path) as session:
        slam.begin(session)
        for scan in drive.scans:
            slam.process(scan)


def parts(saved):
    """Return the connected parts of a map's graph as sets of vertices, the oldest first."""
    graph = saved.graph()
    structure = networkx.Graph((edge.source, edge.target) for edge in graph.edges)
    structure.add_nodes_from(graph.poses)
    return sorted(networkx.connected_components(structure), key=min)
