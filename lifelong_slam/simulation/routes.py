"""Smooth paths made of straights and turns with clothoid transitions."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import cumulative_simpson, cumulative_trapezoid
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from lifelong_slam.simulation.campaign import Segment

Array = NDArray[np.float64]

_STEP = 0.05  # metres between the samples that a path is integrated over
_CLOSED = 0.05  # metres that a closed lap's ends may miss each other


class Path:
    """A plane curve by arc length `s`, metres; its curvature is continuous.

    `s` is 0 where the route starts (at the origin, along +x). An open path goes on straight for
    `before` metres before that and `after` metres beyond the end; a closed one repeats.
    """

    def __init__(
        self,
        segments: Sequence[Segment],
        *,
        before: float = 0.0,
        after: float = 0.0,
        closed: bool = False,
    ) -> None:
        knots, curvature = _curvature_profile(segments)
        self.length = float(knots[-1])
        self.closed = closed
        self.start, self.end = -before, self.length + after
        self._knots, self._curvature = knots, curvature
        count = max(int(np.ceil((self.end - self.start) / _STEP)), 8)
        s: Array = np.linspace(self.start, self.end, count + 1, dtype=np.float64)
        heading = self._headings(s)
        xy = np.stack([_integral(np.cos(heading), s), _integral(np.sin(heading), s)], axis=1)
        if closed:
            xy -= np.linspace(0, 1, len(s))[:, None] * self._gap(xy)
        self._xy = CubicSpline(s, xy)
        self._heading = CubicSpline(s, heading)
        self._sample_s = np.arange(self.start, self.end, 0.5)
        self._tree = cKDTree(self.point(self._sample_s))

    @classmethod
    def straight(cls, start: ArrayLike, heading: float, length: float) -> "Path":
        """Return a straight path from `start` (2,) along `heading` radians."""
        path = cls([Segment.model_validate({"straight": length})])
        s = np.array([0, length / 2, length])
        direction = np.array([np.cos(heading), np.sin(heading)])
        path._xy = CubicSpline(s, np.asarray(start) + s[:, None] * direction)
        path._heading = CubicSpline(s, np.full(3, heading))
        path._tree = cKDTree(path.point(path._sample_s))
        return path

    def point(self, s: ArrayLike, lateral: ArrayLike = 0.0) -> Array:
        """Return (N, 2) points at (N,) arc lengths, moved left by `lateral` metres."""
        wrapped = self._wrap(s)
        within = np.clip(wrapped, self.start, self.end)  # beyond, the end's tangent goes on
        offset = np.broadcast_to(np.asarray(lateral, dtype=np.float64), within.shape)
        normal = self.normal(within)
        tangent = np.stack([normal[..., 1], -normal[..., 0]], axis=-1)
        beyond = (wrapped - within)[..., None] * tangent
        return np.asarray(self._xy(within) + beyond + offset[..., None] * normal)

    def heading(self, s: ArrayLike) -> Array:
        """Return the (N,) directions of travel in radians (not wrapped within one lap)."""
        return np.asarray(self._heading(np.clip(self._wrap(s), self.start, self.end)))

    def normal(self, s: ArrayLike) -> Array:
        """Return (N, 2) unit vectors to the left."""
        heading = self.heading(s)
        return np.stack([-np.sin(heading), np.cos(heading)], axis=-1)

    def curvature(self, s: ArrayLike) -> Array:
        """Return the (N,) curvatures in 1/m, positive to the left."""
        return np.interp(self._wrap(s), self._knots, self._curvature, left=0.0, right=0.0)

    def project(self, xy: Array) -> tuple[Array, Array, Array]:
        """Return arc length, lateral offset and the rest along the path, (N,), of (N, 2) points.

        The rest is within half a sample (0.25 m), but for points that lie beyond an end.
        """
        _, nearest = self._tree.query(xy)
        s = self._sample_s[nearest]
        offset = xy - self.point(s)
        normal = self.normal(s)
        lateral = (offset * normal).sum(axis=1)
        rest = offset[:, 0] * normal[:, 1] - offset[:, 1] * normal[:, 0]
        return s, lateral, rest

    def _wrap(self, s: ArrayLike) -> Array:
        along = np.asarray(s, dtype=np.float64)
        return np.mod(along, self.length) if self.closed else along

    def _headings(self, s: Array) -> Array:
        """Integrate the curvature exactly: it is linear between knots."""
        at_knots = np.concatenate([[0], cumulative_trapezoid(self._curvature, self._knots)])
        index = np.clip(np.searchsorted(self._knots, s, side="right") - 1, 0, len(at_knots) - 2)
        within = np.clip(s, 0, self.length) - self._knots[index]
        k0, k1 = self._curvature[index], self._curvature[index + 1]
        rate = (k1 - k0) / (self._knots[index + 1] - self._knots[index])
        heading: Array = at_knots[index] + within * (k0 + rate * within / 2)
        return heading

    def _gap(self, xy: Array) -> Array:
        gap: Array = xy[-1] - xy[0]
        if np.linalg.norm(gap) > _CLOSED:
            raise ValueError(f"the route does not close: it ends {gap} m from where it starts")
        return gap


def _integral(values: Array, s: Array) -> Array:
    """Integrate over `s` so that the integral is zero where s is nearest zero."""
    total = cumulative_simpson(values, x=s, initial=0)
    at_zero: Array = np.interp(0.0, s, total)
    return np.asarray(total - at_zero)


def _curvature_profile(segments: Sequence[Segment]) -> tuple[Array, Array]:
    """Return knots of arc length and the curvature there, linear in between."""
    lengths: list[float] = []
    curvatures = [0.0]
    for segment in segments:
        for length, curvature in segment.pieces():
            lengths.append(length)
            curvatures.append(curvature)
    return np.concatenate([[0.0], np.cumsum(lengths)]), np.array(curvatures)
