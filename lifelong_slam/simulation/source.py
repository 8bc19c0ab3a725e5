"""A simulated campaign as a source of scans: recorded once, then read like any other bag."""

import fcntl
import logging
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import ConfigError
from lifelong_slam.scan import Scan
from lifelong_slam.simulation.campaign import Campaign, make_campaign
from lifelong_slam.simulation.recorder import (
    BAG_NAME,
    SURFACE_NAME,
    TRUTH_NAME,
    damage,
    record,
)
from lifelong_slam.simulation.sensors import make_sensor
from lifelong_slam.sources.bag import BagSource
from lifelong_slam.trajectory import Trajectory, read_tum

logger = logging.getLogger(__name__)


class SimulatedSource:
    """Scans of one sensor of a simulated campaign (paper 000, chapter 3).

    The campaign is recorded into `cache_dir` the first time, under a hash of everything that its
    content depends on. The arguments that `Campaign` documents describe it.

    Args:
        topic: of the clouds to read; one of the rig's sensors publishes there.
        cache_dir: folder of recorded campaigns.
        name: see Campaign, as the ones below.
        kind: of world.
        distance: metres, of one lap.
        speed: m/s.
        route: pieces of the route.
        rig: sensors on the car.
        traffic: moving road users.
        crosstalk: share of beams by sensor.
        azimuth_steps: degrees by sensor.
        wobble: metres.
        closed: whether the route closes.
        laps: of a closed route.
        overlap: metres beyond the last lap.
        session: of a place that changes between visits.
        start_shift: metres from session to session.
        seed: of world, traffic and noise.

    Raises:
        ConfigError: a setting is wrong, or the rig has no sensor on `topic`.
    """

    def __init__(
        self,
        topic: str,
        cache_dir: str,
        name: str,
        kind: str,
        distance: float,
        speed: float,
        route: Sequence[Mapping[str, Any]],
        rig: list[str],
        traffic: Sequence[Mapping[str, Any]] = (),
        crosstalk: dict[str, float] | None = None,
        azimuth_steps: dict[str, float] | None = None,
        wobble: float = 0.05,
        closed: bool = False,
        laps: int = 1,
        overlap: float = 0.0,
        session: int | None = None,
        start_shift: float = 0.0,
        seed: int = 0,
    ) -> None:
        self.campaign = make_campaign(
            name=name, kind=kind, distance=distance, speed=speed, route=route, rig=rig,
            traffic=traffic, crosstalk=crosstalk or {}, azimuth_steps=azimuth_steps or {},
            wobble=wobble, closed=closed, laps=laps, overlap=overlap, session=session,
            start_shift=start_shift, seed=seed,
        )  # fmt: skip
        _check_topic(self.campaign, topic)
        self.folder = ensure_recorded(self.campaign, Path(cache_dir))
        self._bag = BagSource(path=str(self.folder / BAG_NAME), topic=topic)

    @property
    def surface_path(self) -> Path:
        """File of points on the true static surface, in the world's frame."""
        return self.folder / SURFACE_NAME

    def __len__(self) -> int:
        return len(self._bag)

    def __iter__(self) -> Iterator[Scan]:
        return iter(self._bag)

    def reference(self) -> Trajectory:
        """Return the true T_world_base at 100 Hz."""
        return read_tum(self.folder / TRUTH_NAME)

    @property
    def T_base_sensor(self) -> NDArray[np.float64]:
        """(4, 4) pose of the sensor on the car, from the bag's /tf_static."""
        return self._bag.T_base_sensor


def ensure_recorded(campaign: Campaign, cache_dir: Path) -> Path:
    """Return the folder of the campaign's recording, making it if it isn't there or is damaged.

    The folder appears whole or not at all. Of several processes one records, the others wait.
    """
    folder = cache_dir / f"{campaign.name}-{campaign.digest()}"
    if folder.is_dir() and not damage(campaign, folder):
        return folder
    cache_dir.mkdir(parents=True, exist_ok=True)
    with _locked(cache_dir / f".{folder.name}.lock"):
        # The holder of the lock is the only one at work, so any other attempt was cut off.
        for leftover in cache_dir.glob(f".{folder.name}-*"):
            shutil.rmtree(leftover, ignore_errors=True)
        what = damage(campaign, folder)
        if folder.is_dir() and what:
            logger.warning("%s is damaged (%s): recording it again", folder, what)
        if what:
            _record_whole(campaign, folder)
    return folder


def _record_whole(campaign: Campaign, folder: Path) -> None:
    temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    try:
        record(campaign, temporary)
        temporary.chmod(0o755)
        shutil.rmtree(folder, ignore_errors=True)
        temporary.rename(folder)
    except OSError as error:
        error.filename = error.filename or str(folder)  # as when the disk is full
        raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold an exclusive lock that the system releases even if the process is killed."""
    with path.open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            logger.info("waiting for another process to record %s", path.stem.lstrip("."))
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _check_topic(campaign: Campaign, topic: str) -> None:
    topics = [make_sensor(name, campaign.azimuth_steps.get(name)).topic for name in campaign.rig]
    if topic not in topics:
        raise ConfigError(f"the rig {list(campaign.rig)} has no topic {topic}: {', '.join(topics)}")
    if len(set(topics)) < len(topics):
        raise ConfigError(f"two sensors of the rig {list(campaign.rig)} share a topic")
