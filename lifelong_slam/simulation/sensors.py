"""The LiDARs of Table 3.1 and where they sit on the car.

The data sheets leave three things open. They are read as follows.
- "Range accuracy +-3 cm" (+-5 cm) is taken as one standard deviation of the range, the reading
  that is least kind to SLAM.
- Bosch B2's number of lines is not published. 64 lines over its 24 degrees, with 0.05 degrees
  between columns, give 153,600 beams a sweep against the 92,400 of the cropped VLS-128: its map is
  the denser one, as the comparison of section 4.2 expects.
- The VLS-128's 128 lines are spread evenly over its 40 degrees (the real ones crowd the horizon).
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import ConfigError, did_you_mean
from lifelong_slam.simulation.mesh import planar

Array = NDArray[np.float64]

SWEEP_SECONDS = 0.1  # both sensors run at 10 Hz
_CROPPED_RANGE = (3.0, 240.0)  # section 3.3.1
_CROPPED_ELEVATION = (-14.0, 10.0)  # 24 degrees of section 3.3.1; a car needs more below than above


@dataclass(frozen=True, slots=True)
class Sensor:
    """A scanning LiDAR: columns from left to right, all beams of a column at one instant.

    Attributes:
        name: key in a campaign's rig.
        topic: where its clouds are published.
        frame: its frame of reference, x forward, y left, z up.
        sigma: standard deviation of the range, metres.
        reach: greatest distance measured, metres; a dark target (reflectivity 0.1) is detected half
            the time at 0.6 of it.
        kept_range: nearest and farthest range in the recording, metres.
        turn: (first, last) azimuth in degrees that the sweep scans at a steady rate.
        kept_azimuth: (first, last) azimuth in degrees kept in the recording.
        azimuth_step: degrees between columns.
        elevations: (R,) degrees, by ring as recorded.
        rings: (R,) ring numbers as recorded.
        T_base_sensor: (4, 4) mounting pose.
    """

    name: str
    topic: str
    frame: str
    sigma: float
    reach: float
    kept_range: tuple[float, float]
    turn: tuple[float, float]
    kept_azimuth: tuple[float, float]
    azimuth_step: float
    elevations: Array
    rings: NDArray[np.uint16]
    T_base_sensor: Array = field(repr=False)

    @property
    def azimuths(self) -> Array:
        """(C,) azimuths of the columns in radians, in the order of time."""
        first, last = self.kept_azimuth
        count = round((first - last) / self.azimuth_step)
        return np.asarray(np.radians(first - (np.arange(count) + 0.5) * self.azimuth_step))

    @property
    def offsets(self) -> Array:
        """(C,) seconds after the sweep's start at which each column is measured."""
        first, last = np.radians(self.turn)
        return np.asarray(SWEEP_SECONDS * (first - self.azimuths) / (first - last))

    @property
    def directions(self) -> Array:
        """(C, R, 3) unit vectors of the beams in the sensor's frame."""
        azimuth = self.azimuths[:, None]
        elevation = np.radians(self.elevations)[None, :]
        x = np.cos(elevation) * np.cos(azimuth)
        y = np.cos(elevation) * np.sin(azimuth)
        z = np.broadcast_to(np.sin(elevation), x.shape)
        return np.stack([x, y, z], axis=-1)


def make_sensor(name: str, azimuth_step: float | None = None) -> Sensor:
    """Return a sensor by name, with another step between columns in degrees if given.

    Raises:
        ConfigError: the name is unknown or the step isn't positive.
    """
    if name not in _SENSORS:
        known = ", ".join(_SENSORS)
        raise ConfigError(f"no sensor '{name}'.{did_you_mean(name, _SENSORS)} There are: {known}")
    if azimuth_step is None:
        return _SENSORS[name]
    if azimuth_step <= 0:
        raise ConfigError(f"the azimuth step of '{name}' must be positive, not {azimuth_step}")
    return replace(_SENSORS[name], azimuth_step=azimuth_step)


def _mounted(x: float, y: float, z: float, yaw_deg: float, pitch_deg: float) -> Array:
    c, s = np.cos(np.radians(pitch_deg)), np.sin(np.radians(pitch_deg))
    tilt = np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1.0]])
    return np.asarray(planar(x, y, z, np.radians(yaw_deg)) @ tilt)


def _vls128(name: str, *, cropped: bool, azimuth_step: float) -> Sensor:
    elevations = -25.0 + (np.arange(128) + 0.5) * 40.0 / 128
    low, high = _CROPPED_ELEVATION if cropped else (-25.0, 15.0)
    rings = np.flatnonzero((elevations >= low) & (elevations <= high))
    return Sensor(
        name=name,
        topic="/velodyne/pointcloud",
        frame="velodyne",
        sigma=0.03,
        reach=300.0,
        kept_range=_CROPPED_RANGE if cropped else (1.0, 300.0),
        turn=(180.0, -180.0),
        kept_azimuth=(60.0, -60.0) if cropped else (180.0, -180.0),
        azimuth_step=azimuth_step,
        elevations=elevations[rings],
        rings=rings.astype(np.uint16),
        T_base_sensor=_mounted(1.10, 0.0, 1.92, yaw_deg=0.2, pitch_deg=0.3),
    )


def _bosch_b2() -> Sensor:
    rings = np.arange(64)
    low, high = _CROPPED_ELEVATION
    return Sensor(
        name="bosch",
        topic="/rbldar/pointcloud",
        frame="bosch_b2",
        sigma=0.05,
        reach=250.0,
        kept_range=_CROPPED_RANGE,
        turn=(60.0, -60.0),
        kept_azimuth=(60.0, -60.0),
        azimuth_step=0.05,
        elevations=low + (rings + 0.5) * (high - low) / 64,
        rings=rings.astype(np.uint16),
        T_base_sensor=_mounted(1.85, 0.12, 1.58, yaw_deg=-0.4, pitch_deg=0.6),
    )


# `bosch` and `velodyne` are cropped alike to 120 x 24 degrees and 3 to 240 m (section 3.3.1). Of
# the spinning VLS-128's revolution that leaves the third that faces forward. `vls128` is the same
# sensor uncropped; its default step of 0.8 degrees (57,600 beams a sweep) instead of the data
# sheet's 0.1 keeps a recording of 20 laps at several GB instead of tens of them.
_SENSORS = {
    sensor.name: sensor
    for sensor in (
        _bosch_b2(),
        _vls128("velodyne", cropped=True, azimuth_step=0.1),
        _vls128("vls128", cropped=False, azimuth_step=0.8),
    )
}
