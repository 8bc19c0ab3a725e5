"""Metrics of a trajectory: paper 000, section 4.1, evo's APE and RPE, KITTI's relative errors."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from evo.core.metrics import RPE

from eval.errors import EvalError, MetricError
from eval.evidence import Evidence
from eval.metrics.metric import Array, Curve, Measurement, Plot, Section
from eval.metrics.percentiles import DEFAULT, checked, spread
from eval.relative import RelativeErrors, over_distance, over_kitti_segments, over_time
from eval.trajectory import TrajectoryComparison

_ALONG = "distance along the reference [m]"


class PositionError:
    """Position errors e_i after alignment, and their absolute value on each axis.

    MAE, MAEx, MAEy, MAEz, MSE and maximum of paper 000, section 4.1; RMSE and the other statistics are
    those of evo's APE of the translation.
    """

    name = "position_error"
    title = "Position error"
    section = Section.TRAJECTORY
    keys: tuple[str, ...] = (
        "mae_m",
        "mae_x_m",
        "mae_y_m",
        "mae_z_m",
        "mse_m2",
        "rmse_m",
        "max_m",
        "percentiles_m",
        "ape_translation_m",
    )
    needs: tuple[str, ...] = ("comparison",)
    unit = "m"
    less_is_better: bool | None = True
    meaning = "How far the estimated position is from the true one, on average over all poses."

    def __init__(self, percentiles: Sequence[float] = DEFAULT) -> None:
        """Choose the percentiles, from 0 to 100.

        Raises:
            MetricError: there are others.
        """
        self._percentiles = checked(percentiles)

    def measure(self, evidence: Evidence) -> Measurement:
        """Sum up the differences of paired positions."""
        comparison = _comparison(evidence)
        errors, differences = comparison.errors, comparison.differences
        x, y, z = np.abs(differences).mean(axis=0).tolist()
        statistics = summary(errors)
        values = {
            "mae_m": statistics["mean"],
            "mae_x_m": x,
            "mae_y_m": y,
            "mae_z_m": z,
            "mse_m2": float((errors**2).mean()),
            "rmse_m": statistics["rmse"],
            "max_m": statistics["max"],
            "percentiles_m": spread(errors, self._percentiles),
            "ape_translation_m": statistics,
        }
        samples = {"error_m": errors, **{f"{a}_m": differences[:, i] for i, a in enumerate("xyz")}}
        return Measurement(
            values, statistics["mean"], samples, self._plots(comparison), comparison.warnings
        )

    def _plots(self, comparison: TrajectoryComparison) -> tuple[Plot, ...]:
        along, error = comparison.distances, "position error [m]"
        axes = tuple(
            Curve(axis, along, comparison.differences[:, i]) for i, axis in enumerate("xyz")
        )
        in_time = Curve("position error", comparison.seconds, comparison.errors)
        on_path = Curve("position error", along, comparison.errors)
        return (
            Plot("Position error over time", _time_label(comparison), error, (in_time,)),
            Plot("Position error along the path", _ALONG, error, (on_path,)),
            Plot("Position error by axis", _ALONG, "estimate - reference [m]", axes),
        )


class RotationError:
    """Angles between estimated and true orientation after alignment: evo's APE of the rotation."""

    name = "rotation_error"
    title = "Rotation error"
    section = Section.TRAJECTORY
    keys: tuple[str, ...] = ("ape_rotation_deg",)
    needs: tuple[str, ...] = ("comparison",)
    unit = "deg"
    less_is_better: bool | None = True
    meaning = "How far the estimated orientation is turned from the true one, on average."

    def measure(self, evidence: Evidence) -> Measurement:
        """Sum up the angles between paired orientations."""
        comparison = _comparison(evidence)
        errors = comparison.rotation_errors
        statistics = summary(errors)
        curve = Curve("rotation error", comparison.distances, errors)
        plot = Plot("Rotation error along the path", _ALONG, "rotation error [deg]", (curve,))
        return Measurement(
            {"ape_rotation_deg": statistics},
            statistics["mean"],
            {"error_deg": errors},
            (plot,),
            comparison.warnings,
        )


class RelativePoseError:
    """Errors of the motion over short pieces of the path (evo's RPE), whatever the alignment."""

    name = "relative_pose_error"
    title = "Relative pose error"
    section = Section.TRAJECTORY
    keys: tuple[str, ...] = ("rpe",)
    needs: tuple[str, ...] = ("comparison",)
    unit = "m"
    less_is_better: bool | None = True

    def __init__(
        self, metres: Sequence[float] = (1.0, 10.0), seconds: Sequence[float] = (1.0,)
    ) -> None:
        """Choose the lengths of the pieces; the first one is that of the headline.

        Args:
            metres: along the reference's path.
            seconds: only for trajectories with stamps.

        Raises:
            MetricError: there is no length, or one isn't at least a millimetre or millisecond.
        """
        lengths = (*metres, *seconds)
        if not lengths or min(lengths) < 1e-3:
            raise MetricError(
                f"RPE needs lengths of at least 0.001 m or s, not metres={[*metres]},"
                f" seconds={[*seconds]}"
            )
        self._metres, self._seconds = tuple(metres), tuple(seconds)
        first = f"{metres[0]:g} m" if metres else f"{seconds[0]:g} s"
        self.meaning = (
            f"How far the estimated motion over {first} is off (root mean square): local drift,"
            " without what went wrong before."
        )

    def measure(self, evidence: Evidence) -> Measurement:
        """Compare the motions; pieces that the path or the time is too short for are None."""
        comparison = _comparison(evidence)
        pair = (comparison.estimate, comparison.reference)
        errors = {f"{delta:g} m": over_distance(*pair, delta) for delta in self._metres}
        if comparison.pairs.stamped:
            errors |= {f"{delta:g} s": over_time(*pair, delta) for delta in self._seconds}
        found = {name: e for name, e in errors.items() if e is not None}
        headline = next(iter(errors.values()), None)
        return Measurement(
            {"rpe": {name: _rpe(e) for name, e in errors.items()}},
            None if headline is None else summary(headline.translation)["rmse"],
            _rpe_samples(found),
            _rpe_plots(comparison, found),
        )


class KittiErrors:
    """Relative errors of the KITTI odometry benchmark, over segments of 100 to 800 m."""

    name = "kitti_errors"
    title = "KITTI relative error"
    section = Section.TRAJECTORY
    keys: tuple[str, ...] = ("kitti",)
    needs: tuple[str, ...] = ("comparison",)
    unit = "%"
    less_is_better: bool | None = True
    meaning = (
        "How far the path drifts off over segments of 100 to 800 m, in percent of their length."
    )

    def measure(self, evidence: Evidence) -> Measurement:
        """Average over segments; None on paths under 100 m."""
        comparison = _comparison(evidence)
        found = over_kitti_segments(comparison.estimate, comparison.reference)
        if found is None:
            return Measurement({"kitti": None}, None)
        lengths, errors = found
        percent, turn = 100 * errors.translation / lengths, errors.rotation / lengths
        chosen = {n: lengths == n for n in np.unique(lengths).tolist()}
        by_length = {f"{n:.0f}": _kitti(percent[c], turn[c]) for n, c in chosen.items()}
        overall = _kitti(percent, turn)
        curve = Curve(
            "translation",
            np.array([*chosen]),
            np.array([mean["translation_percent"] for mean in by_length.values()]),
        )
        return Measurement(
            {"kitti": {**overall, "by_length_m": by_length}},
            overall["translation_percent"],
            {"length_m": lengths, "translation_percent": percent, "rotation_deg_per_m": turn},
            (Plot("KITTI error by length", "segment [m]", "translation error [%]", (curve,)),),
        )


class PathLength:
    """How long the estimated path is, and of how many poses."""

    name = "path_length"
    title = "Path length"
    section = Section.TRAJECTORY
    keys: tuple[str, ...] = ("path_length_m", "poses")
    needs: tuple[str, ...] = ("estimate",)
    unit = "m"
    less_is_better: bool | None = None
    meaning = "How long the estimated path is."

    def measure(self, evidence: Evidence) -> Measurement:
        """Add up the steps, and count what became of the poses where there is a reference."""
        if evidence.estimate is None:
            raise EvalError("there is no estimated trajectory")
        length = float(evidence.estimate.path_length)
        poses = {"estimated": int(evidence.estimate.num_poses)}
        if evidence.comparison is not None:
            pairs = evidence.comparison.pairs
            poses |= {
                "matched": int(pairs.estimate.num_poses),
                "outside_reference": pairs.outside,
                "in_reference_gaps": pairs.in_gaps,
                "repeated_stamps": pairs.repeated,
            }
        return Measurement({"path_length_m": length, "poses": poses}, length)


class Coverage:
    """How much of the reference the estimate covers, and how it was moved onto it."""

    name = "coverage"
    title = "Coverage of the reference"
    section = Section.TRAJECTORY
    keys: tuple[str, ...] = ("coverage", "reference_path_length_m", "alignment")
    needs: tuple[str, ...] = ("comparison",)
    unit = ""
    less_is_better: bool | None = False
    meaning = "The share of the reference's duration over which poses were compared."

    def measure(self, evidence: Evidence) -> Measurement:
        """Report how the trajectories were paired and aligned."""
        comparison = _comparison(evidence)
        alignment = comparison.alignment
        coverage = comparison.pairs.coverage
        values = {
            "coverage": coverage,
            "reference_path_length_m": float(comparison.reference.path_length),
            "alignment": {
                "method": alignment.method,
                "rotation": alignment.R.tolist(),
                "translation_m": alignment.t.tolist(),
                "scale": alignment.scale,
            },
        }
        return Measurement(values, coverage, warnings=comparison.warnings)


def summary(errors: Array) -> dict[str, float]:
    """Return evo's statistics of (N,) errors."""
    metric = RPE()
    metric.error = errors
    return {name: float(value) for name, value in metric.get_all_statistics().items()}


def _comparison(evidence: Evidence) -> TrajectoryComparison:
    if evidence.comparison is None:
        raise EvalError(evidence.reasons.get("comparison", "there is no comparison"))
    return evidence.comparison


def _time_label(comparison: TrajectoryComparison) -> str:
    return "time since the first pair [s]" if comparison.pairs.stamped else "pose"


def _rpe(errors: RelativeErrors | None) -> dict[str, Any] | None:
    if errors is None:
        return None
    return {
        "pairs": len(errors.first),
        "translation_m": summary(errors.translation),
        "rotation_deg": summary(errors.rotation),
    }


def _rpe_samples(found: Mapping[str, RelativeErrors]) -> dict[str, Array]:
    return {
        f"{delta}, {unit}": values
        for delta, errors in found.items()
        for unit, values in (
            ("translation_m", errors.translation),
            ("rotation_deg", errors.rotation),
        )
    }


def _rpe_plots(
    comparison: TrajectoryComparison, found: Mapping[str, RelativeErrors]
) -> tuple[Plot, ...]:
    """Show each piece's error where it ends."""
    if not found:
        return ()
    along = {name: comparison.distances[errors.last] for name, errors in found.items()}
    moves = tuple(Curve(f"over {n}", along[n], e.translation) for n, e in found.items())
    turns = tuple(Curve(f"over {n}", along[n], e.rotation) for n, e in found.items())
    return (
        Plot("Relative pose error: translation", _ALONG, "translation error [m]", moves),
        Plot("Relative pose error: rotation", _ALONG, "rotation error [deg]", turns),
    )


def _kitti(percent: Array, turn: Array) -> dict[str, Any]:
    return {
        "translation_percent": float(percent.mean()),
        "rotation_deg_per_m": float(turn.mean()),
        "segments": len(percent),
    }
