"""How fast a campaign is recorded, beside bare ray casting on the same rays.

Casts, measures and writes sweeps of the uncropped VLS-128 at the data sheet's 0.1 degrees (460,800
beams) through the town of `loop`, and prints sweeps/s with where the time goes.

    python benchmarks/recording.py [--sweeps 40]
"""

import argparse
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from omegaconf import OmegaConf
from rosbags.rosbag1 import Writer

from lifelong_slam.simulation.campaign import Campaign, make_campaign
from lifelong_slam.simulation.messages import CLOUD_TYPE, TYPESTORE, cloud_message
from lifelong_slam.simulation.raycast import Caster, SweepCaster
from lifelong_slam.simulation.returns import measure
from lifelong_slam.simulation.sensors import make_sensor
from lifelong_slam.simulation.worlds import make_world

_CONFIG = Path(__file__).parents[1] / "conf" / "scenario" / "loop.yaml"
_NOT_OF_THE_CAMPAIGN = ("_target_", "topic", "cache_dir")


class Stopwatch:
    """Seconds spent by stage."""

    def __init__(self) -> None:
        self.spent: dict[str, float] = defaultdict(float)

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Add the time of the block to a stage."""
        start = time.perf_counter()
        yield
        self.spent[stage] += time.perf_counter() - start


def main() -> None:
    """Run the benchmark and print its figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--sweeps", type=int, default=40)
    sweeps = parser.parse_args().sweeps
    world = make_world(_campaign())
    static, sensor = Caster(world.static), make_sensor("vls128", 0.1)
    caster = SweepCaster(sensor, world.motion, static, world.actors)
    watch, rng = Stopwatch(), np.random.Generator(np.random.SFC64(0))
    starts = np.linspace(0, world.motion.duration - 0.1, sweeps).tolist()
    caster.cast(0.0)  # the first call builds the tree of triangles
    with tempfile.TemporaryDirectory() as folder, Writer(Path(folder) / "sweeps.bag") as bag:
        cloud = bag.add_connection(sensor.topic, CLOUD_TYPE, typestore=TYPESTORE)
        for k, start in enumerate(starts):
            with watch.measure("cast"):
                hits = caster.cast(start)
            with watch.measure("measure"):
                returns = measure(hits, sensor, rng)
            with watch.measure("write"):
                stamp = 10**18 + k * 10**8
                message = cloud_message(
                    returns, sensor, caster.directions, caster.offsets, stamp, k
                )
                bag.write(cloud, stamp, message)
            rays, _ = caster.rays(start)
            with watch.measure("bare"):
                static.cast_only(rays.reshape(-1, 6))
    _report(watch.spent, sweeps, int(np.prod(caster.directions.shape[:2])))


def _campaign() -> Campaign:
    settings = OmegaConf.to_container(OmegaConf.load(_CONFIG), resolve=False)
    assert isinstance(settings, dict)
    plain = {str(k): v for k, v in settings.items() if k not in _NOT_OF_THE_CAMPAIGN}
    return make_campaign(**plain | {"rig": ["vls128"], "laps": 1})


def _report(spent: dict[str, float], sweeps: int, rays: int) -> None:
    whole = sum(seconds for stage, seconds in spent.items() if stage != "bare")
    print(f"VLS-128, {rays} beams a sweep, {sweeps} sweeps")
    print(f"recording          {sweeps / whole:6.1f} sweeps/s")
    for stage, seconds in spent.items():
        print(f"  {stage:<16} {1e3 * seconds / sweeps:6.1f} ms a sweep")
    rates = [sweeps * rays / seconds / 1e6 for seconds in (whole, spent["bare"])]
    print(f"recording          {rates[0]:6.2f} million rays/s")
    print(f"bare cast_rays     {rates[1]:6.2f} million rays/s; ratio {rates[0] / rates[1]:.2f}")


if __name__ == "__main__":
    main()
