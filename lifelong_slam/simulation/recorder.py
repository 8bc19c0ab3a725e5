"""Recording a campaign: the bag that SLAM reads, and the truth beside it."""

import json
import logging
import math
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader, ReaderError, Writer

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
from lifelong_slam.simulation.movables import SeenMovables, write_movables
from lifelong_slam.simulation.raycast import Caster, Floats, SweepCaster
from lifelong_slam.simulation.returns import measure
from lifelong_slam.simulation.sensors import SWEEP_SECONDS, Sensor, make_sensor
from lifelong_slam.simulation.surface import visible_surface
from lifelong_slam.simulation.truth import LabelWriter, write_mesh_ply, write_points_ply
from lifelong_slam.simulation.worlds import World, make_world
from lifelong_slam.trajectory import Trajectory, write_tum

logger = logging.getLogger(__name__)

START_STAMP = 1_655_283_600 * NANOSECONDS  # 15 June 2022, 09:00 UTC
_SEASON = 91 * 86_400 * NANOSECONDS  # from one session to the next
CAMPAIGN_NAME, BAG_NAME, TRUTH_NAME = "campaign.json", "campaign.bag", "truth.tum"
SURFACE_NAME, WORLD_NAME, MOVABLES_NAME = "surface.ply", "world.ply", "movable.npz"

_SURFACE_SPACING = 2.0  # metres driven between the places that the surface is looked at from
_SURFACE_STRIDE = 3  # every third column is enough for voxels of half a metre


def record(campaign: Campaign, folder: Path) -> None:
    """Record a campaign into an existing, empty folder, with a progress bar on stderr."""
    world = make_world(campaign)
    sensors = [make_sensor(name, campaign.azimuth_steps.get(name)) for name in campaign.rig]
    static = Caster(world.static)
    casters = [SweepCaster(sensor, world.motion, static, world.actors) for sensor in sensors]
    logger.info("recording %s: %d triangles", campaign.name, len(world.static))
    _write_bag(campaign, world, casters, folder)
    _write_truth(campaign, world, casters, folder)
    description = {
        "simulation_version": SIMULATION_VERSION,
        **campaign.settings(),
        "sizes": {path.name: path.stat().st_size for path in sorted(folder.iterdir())},
    }
    (folder / CAMPAIGN_NAME).write_text(json.dumps(description, indent=2) + "\n")


def damage(campaign: Campaign, folder: Path) -> str | None:
    """Say what is wrong with the recording of a campaign, as of a copy that was cut short; or None.

    Files must have the sizes that campaign.json gives (those from before it did have none), and the bag
    each sensor's sweeps.
    """
    try:
        sizes = json.loads((folder / CAMPAIGN_NAME).read_text()).get("sizes", {})
        for name, size in sizes.items():
            if (found := (folder / name).stat().st_size) != size:
                return f"{name} has {found} bytes of {size}"
        with Reader(folder / BAG_NAME) as bag:
            counts = {connection.topic: connection.msgcount for connection in bag.connections}
    except (ValueError, AttributeError):
        return f"{CAMPAIGN_NAME} can't be read"
    except OSError as error:
        return f"{Path(error.filename).name}: {error.strerror}"
    except ReaderError as error:
        return f"{BAG_NAME}: {error}"
    for topic in (make_sensor(name).topic for name in campaign.rig):
        if counts.get(topic) != sweep_count(campaign):
            return f"{BAG_NAME} has {counts.get(topic, 0)} sweeps of {sweep_count(campaign)}"
    return None


def start_stamp(campaign: Campaign) -> int:
    """Return the stamp in nanoseconds of a recording's start; sessions are a season apart."""
    return START_STAMP + ((campaign.session or 1) - 1) * _SEASON


def seconds_to_stamps(campaign: Campaign, t: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the stamps in nanoseconds of (N,) seconds since the recording's start."""
    return start_stamp(campaign) + np.round(t * NANOSECONDS).astype(np.int64)


@dataclass(frozen=True, slots=True)
class _Lidar:
    """A sensor of the rig with all that recording it needs."""

    sensor: Sensor
    caster: SweepCaster
    cloud: Connection
    labels: LabelWriter
    seen: SeenMovables | None

    def record(self, campaign: Campaign, bag: Writer, k: int) -> None:
        """Write the k-th sweep and its labels."""
        start = k * SWEEP_SECONDS
        stamp = int(seconds_to_stamps(campaign, np.array([start]))[0])
        crosstalk = campaign.crosstalk.get(self.sensor.name, 0.0)
        rng = campaign.generator(self.sensor.name, k)
        hits = self.caster.cast(start)
        returns = measure(hits, self.sensor, rng, crosstalk)
        message = cloud_message(
            returns, self.sensor, self.caster.directions, self.caster.offsets, stamp, k
        )
        # Bags hold the time of receipt, and a sweep is only sent once it is complete.
        bag.write(self.cloud, stamp + round(SWEEP_SECONDS * NANOSECONDS), message)
        self.labels.add(stamp, returns.label)
        if self.seen:
            rays, _ = self.caster.rays(start)
            self.seen.add(rays, hits, returns)


def _write_bag(campaign: Campaign, world: World, casters: list[SweepCaster], folder: Path) -> None:
    sweeps, each = sweep_count(campaign), round(RATE * SWEEP_SECONDS)
    ins = Ins(world.motion, campaign.generator("ins"))
    seen = SeenMovables(world.movables, len(world.static)) if world.movables else None
    with ExitStack() as stack:
        bag = stack.enter_context(Writer(folder / BAG_NAME))
        progress = stack.enter_context(_progress_bar())
        tf = bag.add_connection("/tf_static", TF_TYPE, typestore=TYPESTORE, latching=1)
        imar = bag.add_connection("/imar/odom", ODOMETRY_TYPE, typestore=TYPESTORE)
        lidars = []
        for caster in casters:
            sensor = caster.sensor
            cloud = bag.add_connection(sensor.topic, CLOUD_TYPE, typestore=TYPESTORE)
            labels = stack.enter_context(LabelWriter(folder, sensor.name))
            lidars.append(_Lidar(sensor, caster, cloud, labels, seen))
        first = start_stamp(campaign)
        bag.write(tf, first, mounting_message([caster.sensor for caster in casters], first))
        name = f"Recording scenario {campaign.name}"
        for k in progress.track(range(sweeps), description=name):
            for stamp, message in _odometry(campaign, ins, range(k * each, (k + 1) * each)):
                bag.write(imar, stamp, message)
            for lidar in lidars:
                lidar.record(campaign, bag, k)
        rest = range(sweeps * each, _sample_count(campaign))
        for stamp, message in _odometry(campaign, ins, rest):
            bag.write(imar, stamp, message)
    if seen:
        write_movables(folder / MOVABLES_NAME, seen.truth())


def sweep_count(campaign: Campaign) -> int:
    """Return how many sweeps fit into the campaign, to the nearest one."""
    return round(campaign.duration / SWEEP_SECONDS)


def _sample_count(campaign: Campaign) -> int:
    """Return how many poses are kept: they cover the whole campaign and all of the last sweep."""
    seconds = max(campaign.duration, sweep_count(campaign) * SWEEP_SECONDS)
    return math.floor(seconds * RATE + 1e-6) + 1


def _odometry(campaign: Campaign, ins: Ins, samples: range) -> Iterator[tuple[int, bytes]]:
    """Yield stamp and message of the odometry by the number of the sample."""
    t = np.array(samples) / RATE
    for i, stamp, T, twist in zip(
        samples, seconds_to_stamps(campaign, t).tolist(), *ins.measure(t), strict=True
    ):
        yield stamp, odometry_message(T, twist, ins.deviations, stamp, i)


def _write_truth(
    campaign: Campaign, world: World, casters: list[SweepCaster], folder: Path
) -> None:
    t = np.arange(_sample_count(campaign)) / RATE
    stamps = seconds_to_stamps(campaign, t)
    write_tum(folder / TRUTH_NAME, Trajectory(stamps, world.motion.poses(t)))
    step = max(round(_SURFACE_SPACING / campaign.speed / SWEEP_SECONDS), 1)
    one_lap = int(sweep_count(campaign) / (campaign.laps + campaign.overlap / campaign.distance))
    with _progress_bar() as progress:
        sweeps = progress.track(range(0, one_lap, step), description="Sampling the true surface")
        points = visible_surface(
            world.static,
            _views(casters, sweeps),
            campaign.generator("surface"),
            reach=max(caster.sensor.kept_range[1] for caster in casters),
        )
    write_points_ply(folder / SURFACE_NAME, points)
    write_mesh_ply(folder / WORLD_NAME, world.static.triangles)


def _views(casters: list[SweepCaster], sweeps: Iterable[int]) -> Iterator[Floats]:
    for k in sweeps:
        for caster in casters:
            rays, _ = caster.rays(k * SWEEP_SECONDS)
            yield rays[::_SURFACE_STRIDE].reshape(-1, 6)


def _progress_bar() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
    )
