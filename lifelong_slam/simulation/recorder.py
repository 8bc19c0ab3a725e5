"""Recording a campaign: the bag that SLAM reads, and the truth beside it."""

import json
import logging
import zlib
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rosbags.rosbag1 import Writer

from lifelong_slam.scan import NANOSECONDS
from lifelong_slam.simulation.campaign import SIMULATION_VERSION, Campaign
from lifelong_slam.simulation.ins import RATE, Ins
from lifelong_slam.simulation.messages import (
    CLOUD_TYPE,
    ODOMETRY_TYPE,
    TF_TYPE,
    TYPESTORE,
    cloud_message,
    mounting_message,
    odometry_message,
)
from lifelong_slam.simulation.raycast import Caster, Floats, SweepCaster
from lifelong_slam.simulation.returns import measure
from lifelong_slam.simulation.sensors import SWEEP_SECONDS, Sensor, make_sensor
from lifelong_slam.simulation.surface import visible_surface
from lifelong_slam.simulation.truth import LabelWriter, write_mesh_ply, write_points_ply
from lifelong_slam.simulation.worlds import World, make_world
from lifelong_slam.trajectory import Trajectory, write_tum

logger = logging.getLogger(__name__)

START_STAMP = 1_655_283_600 * NANOSECONDS  # 15 June 2022, 09:00 UTC
BAG_NAME, TRUTH_NAME = "campaign.bag", "truth.tum"
SURFACE_NAME, WORLD_NAME = "surface.ply", "world.ply"

_SURFACE_SPACING = 2.0  # metres driven between the places that the surface is looked at from
_SURFACE_STRIDE = 3  # every third column is enough for voxels of half a metre


def record(campaign: Campaign, folder: Path) -> None:
    """Record a campaign into an existing, empty folder, with a progress bar on stderr."""
    world = make_world(campaign)
    sensors = [make_sensor(name, campaign.azimuth_steps.get(name)) for name in campaign.rig]
    static = Caster(world.static)
    casters = [SweepCaster(sensor, world.motion, static, world.actors) for sensor in sensors]
    logger.info("recording %s: %d triangles", campaign.name, len(world.static))
    _write_bag(campaign, world, sensors, casters, folder)
    _write_truth(campaign, world, casters, folder)
    description = {"simulation_version": SIMULATION_VERSION, **campaign.model_dump(mode="json")}
    (folder / "campaign.json").write_text(json.dumps(description, indent=2) + "\n")


def seconds_to_stamps(t: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the stamps in nanoseconds of (N,) seconds since the recording's start."""
    return START_STAMP + np.round(t * NANOSECONDS).astype(np.int64)


def _write_bag(
    campaign: Campaign,
    world: World,
    sensors: list[Sensor],
    casters: list[SweepCaster],
    folder: Path,
) -> None:
    sweeps = sweep_count(campaign)
    ins = Ins(world.motion, _generator(campaign, "ins"))
    with ExitStack() as stack:
        bag = stack.enter_context(Writer(folder / BAG_NAME))
        labels = [stack.enter_context(LabelWriter(folder, sensor.name)) for sensor in sensors]
        progress = stack.enter_context(_progress_bar())
        task = progress.add_task(f"Recording scenario {campaign.name}", total=sweeps)
        tf = bag.add_connection("/tf_static", TF_TYPE, typestore=TYPESTORE, latching=1)
        imar = bag.add_connection("/imar/odom", ODOMETRY_TYPE, typestore=TYPESTORE)
        clouds = [
            bag.add_connection(sensor.topic, CLOUD_TYPE, typestore=TYPESTORE) for sensor in sensors
        ]
        bag.write(tf, START_STAMP, mounting_message(sensors, START_STAMP))
        for k in range(sweeps):
            for stamp, message in _odometry(ins, k, last=k == sweeps - 1):
                bag.write(imar, stamp, message)
            start = k * SWEEP_SECONDS
            stamp = int(seconds_to_stamps(np.array([start]))[0])
            for sensor, caster, cloud, label in zip(sensors, casters, clouds, labels, strict=True):
                returns = measure(
                    caster.cast(start),
                    sensor,
                    _generator(campaign, sensor.name, k),
                    campaign.crosstalk.get(sensor.name, 0.0),
                )
                message = cloud_message(
                    returns, sensor, caster.directions, caster.offsets, stamp, k
                )
                # Bags hold the time of receipt, and a sweep is only sent once it is complete.
                bag.write(cloud, stamp + round(SWEEP_SECONDS * NANOSECONDS), message)
                label.add(stamp, returns.label)
            progress.advance(task)


def sweep_count(campaign: Campaign) -> int:
    """Return how many whole sweeps fit into the campaign."""
    return int(campaign.duration / SWEEP_SECONDS + 1e-6)


def _odometry(ins: Ins, sweep: int, *, last: bool) -> Iterator[tuple[int, bytes]]:
    """Yield stamp and message of the odometry within a sweep; the last one has its end as well."""
    each = round(RATE * SWEEP_SECONDS)
    index = np.arange(sweep * each, (sweep + 1) * each + last)
    t = index / RATE
    for i, stamp, T, twist in zip(
        index.tolist(), seconds_to_stamps(t).tolist(), *ins.measure(t), strict=True
    ):
        yield stamp, odometry_message(T, twist, ins.deviations, stamp, i)


def _write_truth(
    campaign: Campaign, world: World, casters: list[SweepCaster], folder: Path
) -> None:
    t = np.arange(round(sweep_count(campaign) * SWEEP_SECONDS * RATE) + 1) / RATE
    write_tum(folder / TRUTH_NAME, Trajectory(seconds_to_stamps(t), world.motion.poses(t)))
    step = max(round(_SURFACE_SPACING / campaign.speed / SWEEP_SECONDS), 1)
    one_lap = int(sweep_count(campaign) / campaign.laps)
    with _progress_bar() as progress:
        sweeps = progress.track(range(0, one_lap, step), description="Sampling the true surface")
        points = visible_surface(
            world.static,
            _views(casters, sweeps),
            _generator(campaign, "surface"),
            reach=max(caster.sensor.kept_range[1] for caster in casters),
        )
    write_points_ply(folder / SURFACE_NAME, points)
    write_mesh_ply(folder / WORLD_NAME, world.static.triangles)


def _views(casters: list[SweepCaster], sweeps: Iterable[int]) -> Iterator[Floats]:
    for k in sweeps:
        for caster in casters:
            rays, _ = caster.rays(k * SWEEP_SECONDS)
            yield rays[::_SURFACE_STRIDE].reshape(-1, 6)


def _generator(campaign: Campaign, what: str, index: int = 0) -> np.random.Generator:
    """Return a generator of its own for each use: nothing depends on the order of use."""
    return np.random.Generator(
        np.random.SFC64(np.random.SeedSequence([campaign.seed, zlib.crc32(what.encode()), index]))
    )


def _progress_bar() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
    )
