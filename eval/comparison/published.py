"""The figures of the published campaigns that the simulated ones are held against.

Source: G. Pereira, *A Methodology to Evaluate the Performance of LiDAR-based SLAM Algorithms*, Tables 5.1
(MAE and maximum of the trajectory), 5.2 (MSE) and 5.3 (maps, from Bosch to Velodyne). Another car, place
and reference, so they say which size of error to expect.
"""

from collections.abc import Mapping

SOURCE = "Pereira, A Methodology to Evaluate the Performance of LiDAR-based SLAM Algorithms"
SCENARIOS = ("A", "B", "C", "D", "E", "F")
SENSORS = ("velodyne", "bosch")

# By figure and sensor, for scenarios A to F.
TRAJECTORY: Mapping[str, Mapping[str, tuple[float, ...]]] = {
    "mae_m": {
        "velodyne": (0.25, 0.61, 0.10, 0.09, 1.22, 1.20),
        "bosch": (0.20, 1.25, 0.10, 0.11, 2.07, 0.88),
    },
    "max_m": {
        "velodyne": (0.56, 0.98, 0.31, 0.21, 3.04, 4.66),
        "bosch": (0.66, 2.68, 0.33, 0.22, 5.70, 4.35),
    },
    "mse_m2": {
        "velodyne": (0.08, 0.45, 0.01, 0.01, 1.75, 1.74),
        "bosch": (0.05, 1.91, 0.01, 0.01, 5.26, 0.99),
    },
}
# By figure and direction, for scenarios A to F.
MAP: Mapping[str, Mapping[tuple[str, str], tuple[float, ...]]] = {
    "hausdorff_m": {("bosch", "velodyne"): (7.75, 8.35, 47.34, 7.02, 23.58, 7.91)},
    "mean_m": {("bosch", "velodyne"): (0.04, 0.48, 0.21, 0.55, 9.39, 4.61)},
}


def published_trajectory(figure: str, scenario: str, sensor: str) -> float | None:
    """Return a figure of Tables 5.1 and 5.2, if they have it."""
    return _at(TRAJECTORY.get(figure, {}).get(sensor), scenario)


def published_map(figure: str, scenario: str, source: str, target: str) -> float | None:
    """Return a figure of Table 5.3, if it has it: distances from each point of `source` to `target`."""
    return _at(MAP.get(figure, {}).get((source, target)), scenario)


def _at(figures: tuple[float, ...] | None, scenario: str) -> float | None:
    if figures is None or scenario not in SCENARIOS:
        return None
    return figures[SCENARIOS.index(scenario)]
