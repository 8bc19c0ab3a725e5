"""Saved maps as standard files. Here, as in the run folder, all becomes poses and points of the base."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import MapError
from lifelong_slam.io.g2o import write_g2o
from lifelong_slam.io.grid import write_grid
from lifelong_slam.io.pcd import write_pcd
from lifelong_slam.io.ply import write_ply
from lifelong_slam.mapping.occupancy import occupancy_grid
from lifelong_slam.mapping.saved_map import SavedMap
from lifelong_slam.mapping.static_map import StaticMap
from lifelong_slam.run_folder import graph_to_base, points_to_base, trajectory_to_base
from lifelong_slam.trajectory import write_tum


def export_map(saved: SavedMap, path: Path, resolution: float) -> None:
    """Write a map as what the name of the file asks for.

    Args:
        saved: the map, or `SavedMap.of_sessions` of it.
        path: ends with .ply or .pcd (static points), .g2o (pose graph), .tum (pose at every scan ever
            taken) or .yaml (occupancy grid, with a .pgm beside it).
        resolution: metres, edge of the grid's cells.

    Raises:
        MapError: the name has another ending, or the map doesn't hold what it asks for.
    """
    writers: dict[str, Callable[[], None]] = {
        ".ply": lambda: write_ply(path, static_points(saved)),
        ".pcd": lambda: write_pcd(path, static_points(saved)),
        ".g2o": lambda: write_g2o(path, graph_to_base(saved.graph(), saved.info.T_base_sensor)),
        ".tum": lambda: write_tum(
            path, trajectory_to_base(saved.trajectory(), saved.info.T_base_sensor)
        ),
        ".yaml": lambda: write_grid(
            path, occupancy_grid(static_points(saved), _sensors(saved), resolution)
        ),
    }
    if path.suffix not in writers:
        raise MapError(f"can't write {path.name}: its name must end with {', '.join(writers)}")
    writers[path.suffix]()


def static_points(saved: SavedMap) -> NDArray[np.float32]:
    """Return (M, 3) static points in the base's map frame.

    Keyframes that a killed run left unsettled are settled, in memory only.
    """
    static_map = StaticMap(saved.info.voxel_size)
    static_map.restore(saved.voxels())
    poses = {i: saved.poses[i] for i in saved.keyframes}
    unsettled = {i: k for i, k in saved.keyframes.items() if len(k.points)}
    static_map.settle(list(unsettled.values()), [poses[i] for i in unsettled], poses)
    return points_to_base(static_map.points(poses), saved.info.T_base_sensor)


def _sensors(saved: SavedMap) -> NDArray[np.float64]:
    """Return (K, 3) positions of the sensor in the base's map frame, at every scan."""
    poses = saved.keyframe_poses()
    positions = [(poses[s.anchor] @ s.T_anchor_scan)[:, :3, 3] for s in saved.scans]
    joined = np.concatenate([np.zeros((0, 3)), *positions])
    return points_to_base(joined.astype(np.float32), saved.info.T_base_sensor).astype(np.float64)
