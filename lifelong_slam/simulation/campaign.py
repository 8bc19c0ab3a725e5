"""What a campaign is, as data: route, traffic, rig and seed, checked before anything is built."""

import hashlib
import json
import math
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from lifelong_slam.errors import ConfigError
from lifelong_slam.simulation.seeds import generator
from lifelong_slam.simulation.sensors import make_sensor

# Counts up whenever the same config would give another recording, so that no stale one is read.
SIMULATION_VERSION = 8

# Left out of a campaign's digest where unset, so that recordings from before there were sessions
# are still found.
_LATE_SETTINGS = ("overlap", "session", "start_shift")

_DISTANCE_TOLERANCE = 0.005  # of the distance that the route's segments may differ from it


class _Data(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=False)


class Segment(_Data):
    """A piece of route: a `straight` in metres, or a `turn` in degrees (left is positive).

    A turn of a `radius` in metres is entered and left over clothoids of `ramp` metres each, in
    which the curvature grows and falls linearly, as a car is steered.
    """

    straight: float | None = Field(None, gt=0)
    turn: float | None = None
    radius: float | None = Field(None, gt=0)
    ramp: float = Field(4.0, gt=0)

    @model_validator(mode="after")
    def _one_kind(self) -> "Segment":
        if (self.straight is None) == (self.turn is None):
            raise ValueError("a segment needs either 'straight' or 'turn'")
        if self.turn is not None:
            if self.radius is None:
                raise ValueError("a 'turn' needs a 'radius'")
            if self._arc() <= 0:
                raise ValueError("the turn is too short for its 'ramp'")
        return self

    def _arc(self) -> float:
        assert self.turn is not None
        assert self.radius is not None
        return self.radius * math.radians(abs(self.turn)) - self.ramp

    def pieces(self) -> list[tuple[float, float]]:
        """Return (length in metres, curvature at its end in 1/m) of each piece."""
        if self.straight is not None:
            return [(self.straight, 0.0)]
        assert self.turn is not None
        assert self.radius is not None
        curvature = math.copysign(1 / self.radius, self.turn)
        return [(self.ramp, curvature), (self._arc(), curvature), (self.ramp, 0.0)]

    @property
    def length(self) -> float:
        """Length in metres."""
        return sum(length for length, _ in self.pieces())


class Traffic(_Data):
    """A stream of road users that keep their lane and speed.

    Attributes:
        kind: what they are.
        road: `route`, or `motorway` (the road that scenario E's ramp joins).
        direction: with or against the direction of the road.
        lateral: metres left of the road's line.
        speed: m/s.
        count: how many.
        first: metres along the road of the first at the start of the recording.
        gap: mean metres between them; the seed varies it.
    """

    kind: Literal["car", "van", "truck", "cyclist"]
    road: Literal["route", "motorway"] = "route"
    direction: Literal["same", "opposite"]
    lateral: float
    speed: float = Field(gt=0)
    count: int = Field(gt=0)
    first: float
    gap: float = 25.0


class Campaign(_Data):
    """All that a recording depends on.

    Attributes:
        name: the scenario's letter or name.
        kind: the kind of world.
        distance: metres driven, in one lap where there are several.
        speed: average speed, m/s.
        laps: how often a closed route is driven; 1 and open otherwise.
        overlap: metres that a closed route is driven on after the last lap.
        session: which visit of a place that changes between visits, from 1; None for a place that
            stays as it is. See `lifelong_slam.simulation.seasons`.
        start_shift: metres along the route from one session's start to the next one's.
        route: pieces of the route.
        traffic: moving road users.
        crosstalk: share of a sensor's beams that return crosstalk, by sensor.
        rig: names of the sensors on the car.
        azimuth_steps: degrees between columns by sensor, where other than the sensor's own.
        wobble: amplitude of the driver's lateral deviation from the line, metres.
        seed: of the world, the traffic and the noise.
    """

    name: str = Field(min_length=1, pattern=r"^[A-Za-z0-9_-]+$")
    kind: Literal["urban", "highway", "ramp"]
    distance: float = Field(gt=0)
    speed: float = Field(gt=0)
    laps: int = Field(1, ge=1)
    closed: bool = False
    overlap: float = Field(0.0, ge=0)
    session: int | None = Field(None, ge=1, le=300)
    start_shift: float = Field(0.0, ge=0)
    route: tuple[Segment, ...] = Field(min_length=1)
    traffic: tuple[Traffic, ...] = ()
    crosstalk: dict[str, Annotated[float, Field(ge=0, le=0.5)]] = Field(default_factory=dict)
    rig: tuple[str, ...] = Field(min_length=1)
    azimuth_steps: dict[str, float] = Field(default_factory=dict)
    wobble: float = Field(0.05, ge=0)
    seed: int = Field(0, ge=0)

    @model_validator(mode="after")
    def _consistent(self) -> "Campaign":
        length = sum(segment.length for segment in self.route)
        if abs(length - self.distance) > _DISTANCE_TOLERANCE * self.distance:
            raise ValueError(f"the route is {length:.2f} m long, not {self.distance} m")
        if self.laps > 1 and not self.closed:
            raise ValueError("only a closed route can have several laps")
        if (self.overlap or self.start_shift) and not self.closed:
            raise ValueError("only a closed route can have an 'overlap' or a 'start_shift'")
        if self.session is None and self.start_shift:
            raise ValueError("'start_shift' needs a 'session'")
        if self.session is not None and self.kind != "urban":
            raise ValueError("only a world of kind 'urban' changes between sessions")
        if self.kind != "ramp" and any(stream.road == "motorway" for stream in self.traffic):
            raise ValueError("only a world of kind 'ramp' has a 'motorway' for traffic")
        for name in {*self.rig, *self.crosstalk, *self.azimuth_steps}:
            make_sensor(name, self.azimuth_steps.get(name))
        return self

    @property
    def duration(self) -> float:
        """Seconds that the recording takes."""
        return (self.distance * self.laps + self.overlap) / self.speed

    @property
    def start(self) -> float:
        """Metres along the route where the session starts."""
        return 0.0 if self.session is None else (self.session - 1) * self.start_shift

    def generator(self, use: str, index: int = 0) -> np.random.Generator:
        """Return the generator for what differs from session to session, such as noise."""
        visit = "" if self.session is None else f" in session {self.session}"
        return generator(self.seed, use + visit, index)

    def settings(self) -> dict[str, Any]:
        """Return all that the recording depends on, as JSON's types."""
        unset = {name for name in _LATE_SETTINGS if not getattr(self, name)}
        return self.model_dump(mode="json", exclude=unset)

    def digest(self) -> str:
        """Return a short hash of this config and the simulation's version."""
        text = json.dumps([SIMULATION_VERSION, self.settings()], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:12]


def make_campaign(**settings: Any) -> Campaign:
    """Check settings and return them as a campaign.

    Raises:
        ConfigError: a setting is unknown, missing, of the wrong kind or contradicts another.
    """
    try:
        return Campaign(**settings)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        prefix = f"scenario.{where}" if where else "scenario"
        message = first["msg"].removeprefix("Value error, ")
        raise ConfigError(f"{prefix}: {message}") from error
