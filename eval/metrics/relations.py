"""How well a trajectory keeps to true relative poses between some of its instants.

Source: R. Kuemmerle et al., *On measuring the accuracy of SLAM algorithms*, Autonomous Robots 27
(2009).
"""

import numpy as np
from scipy.spatial.transform import Rotation

from eval.association import MAX_GAP, interpolate, within_reach
from eval.errors import AssociationError, EvalError
from eval.evidence import Evidence
from eval.metrics.metric import Curve, Measurement, Plot, Section
from eval.metrics.trajectory import summary


class RelationError:
    """Errors ``delta_ij (-) delta*_ij`` of the estimated relations against the true ones.

    Needs neither a reference trajectory nor an alignment. The estimate is interpolated at the
    relations' stamps; a relation that it doesn't reach is missed, and counted.
    """

    name = "relation_error"
    title = "Relation error"
    section = Section.TRAJECTORY
    keys: tuple[str, ...] = ("relations",)
    needs: tuple[str, ...] = ("estimate", "relations")
    unit = "m"
    less_is_better: bool | None = True
    meaning = "How far the estimated relative position of two instants is off, on average."

    def __init__(self, max_gap: float = MAX_GAP) -> None:
        """Choose the longest time in seconds between two poses to interpolate across."""
        self._max_gap = max_gap

    def measure(self, evidence: Evidence) -> Measurement:
        """Compare the relations that the estimate reaches.

        Raises:
            AssociationError: it reaches none.
        """
        estimate, relations = evidence.estimate, evidence.relations
        if estimate is None or relations is None:
            raise EvalError("there is no estimate, or there are no relations")
        stamps = relations.stamps
        reached = within_reach(estimate, stamps, self._max_gap).all(axis=1)
        used, missed = int(reached.sum()), int((~reached).sum())
        if used == 0:
            times = estimate.timestamps
            raise AssociationError(
                f"the estimate, {times[0]:.3f} to {times[-1]:.3f} s, reaches none of {missed}"
                f" relations, {stamps.min():.3f} to {stamps.max():.3f} s, with gaps of at most"
                f" {self._max_gap} s"
            )
        first, second = (interpolate(estimate, stamps[reached, i]) for i in range(2))
        R, R_second = (
            Rotation.from_quat(poses.orientations_quat_wxyz, scalar_first=True)
            for poses in (first, second)
        )
        true = relations.T_first_second[reached]
        # |t(delta (-) delta*)| = |R*^T (t - t*)| = |t - t*|
        moves = R.inv().apply(second.positions_xyz - first.positions_xyz) - true[:, :3, 3]
        translation = np.linalg.norm(moves, axis=1)
        turns = Rotation.from_matrix(true[:, :3, :3]).inv() * R.inv() * R_second
        rotation = np.degrees(turns.magnitude())
        values = {
            "used": used,
            "missed": missed,
            "translation_m": summary(translation),
            "translation_squared_m2": float((translation**2).mean()),
            "rotation_deg": summary(rotation),
            "rotation_squared_deg2": float((rotation**2).mean()),
        }
        when = stamps[reached].max(axis=1)
        order = np.argsort(when, kind="stable")
        curve = Curve("relation error", when[order] - when[order[0]], translation[order])
        label = "time since the first relation [s]"
        warning = f"{missed} of {used + missed} relations are not within reach of the estimate"
        return Measurement(
            {"relations": values},
            float(translation.mean()),
            {"translation_m": translation, "rotation_deg": rotation},
            (Plot("Relation error", label, "translation error [m]", (curve,)),),
            (warning,) if missed else (),
        )
