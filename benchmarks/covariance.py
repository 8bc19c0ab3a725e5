"""Are the covariances of odometry edges as large as the errors they stand for?

Runs the front end on simulated campaigns, forms edges between keyframes as the pipeline does, and
compares each with the truth: the normalised estimation error squared (NEES) of a consistent
six-dimensional covariance averages 6, with a median of 5.3; those of its rotation and its translation alone
average 3 each.

    python benchmarks/covariance.py [--scenarios A,D,E,F] [--sensors bosch,velodyne] [key=value ...]

Further `key=value` arguments are overrides as `scripts/run.py` takes them: scenario.seed=1 is
another world. `benchmarks/edge_noise.py` judges loop closures likewise.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from throughput import compose_config

from lifelong_slam.config import build
from lifelong_slam.geometry import invert, log
from lifelong_slam.loop_closure.closer import relative_covariance
from lifelong_slam.mapping.keyframe import KeyframeSelector
from lifelong_slam.odometry.odometry import OdometryEstimate

Array = NDArray[np.float64]
ALL, ROTATION, TRANSLATION = slice(0, 6), slice(0, 3), slice(3, 6)


@dataclass(frozen=True, slots=True)
class EdgeErrors:
    """(N, 6) errors of edges in the target's frame, rotation then translation, and covariances."""

    errors: Array
    covariances: Array

    def nees(self, part: slice = ALL) -> Array:
        """(N,) squared Mahalanobis distances, of a part with the rest marginalised."""
        errors, covariances = self.errors[:, part], self.covariances[:, part, part]
        solved = np.linalg.solve(covariances, errors[..., None])[..., 0]
        return np.asarray(np.einsum("ij,ij->i", errors, solved))


def measure(scenario: str, sensor: str, overrides: Sequence[str] = ()) -> EdgeErrors:
    """Run the front end on a campaign and compare its keyframe edges with the truth."""
    config = compose_config([f"scenario={scenario}", f"sensor={sensor}", *overrides])
    source = build(config.scenario)
    odometry = build(config.odometry)
    selector = KeyframeSelector(config.system.keyframe_distance, config.system.keyframe_rotation)
    keyframes = [e for e in (odometry.register(scan) for scan in source) if selector.takes(e)]
    reference = source.reference()
    keyframes = [k for k in keyframes if k.stamp <= reference.stamps[-1]]
    truth = reference.at(np.array([k.stamp for k in keyframes])) @ source.T_base_sensor
    pairs = list(zip(range(len(keyframes) - 1), range(1, len(keyframes)), strict=True))
    edges = [_edge(keyframes[i], keyframes[j], truth[i], truth[j]) for i, j in pairs]
    return EdgeErrors(np.array([e for e, _ in edges]), np.array([c for _, c in edges]))


def _edge(
    source: OdometryEstimate, target: OdometryEstimate, true_source: Array, true_target: Array
) -> tuple[Array, Array]:
    motion = invert(source.T_odom_sensor) @ target.T_odom_sensor
    covariance = relative_covariance(source, target, motion)
    return log(invert(invert(true_source) @ true_target) @ motion), covariance


def main() -> None:
    """Print a Markdown table of error, predicted standard deviation and NEES for each campaign."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--scenarios", default="A,B,C,D,E,F")
    parser.add_argument("--sensors", default="bosch,velodyne")
    parser.add_argument("overrides", nargs="*", help="key=value, as scripts/run.py takes them")
    arguments = parser.parse_args()
    print(
        "| scenario | sensor | edges | error mm | predicted | error mrad | predicted"
        " | NEES mean | median | rotation | translation |"
    )
    print("|" + "---|" * 11)
    for scenario in arguments.scenarios.split(","):
        for sensor in arguments.sensors.split(","):
            edges = measure(scenario, sensor, arguments.overrides)
            print(_row(scenario, sensor, edges), flush=True)


def _row(scenario: str, sensor: str, edges: EdgeErrors) -> str:
    spread = np.sqrt(np.mean(edges.errors**2, axis=0))
    predicted = np.sqrt(np.diagonal(np.median(edges.covariances, axis=0)))
    return (
        f"| {scenario} | {sensor} | {len(edges.errors)} "
        f"| {1e3 * np.linalg.norm(spread[3:]):.1f} | {1e3 * np.linalg.norm(predicted[3:]):.1f} "
        f"| {1e3 * np.linalg.norm(spread[:3]):.2f} | {1e3 * np.linalg.norm(predicted[:3]):.2f} "
        f"| {np.mean(edges.nees()):.1f} | {np.median(edges.nees()):.1f} "
        f"| {np.mean(edges.nees(ROTATION)):.1f} | {np.mean(edges.nees(TRANSLATION)):.1f} |"
    )


if __name__ == "__main__":
    main()
