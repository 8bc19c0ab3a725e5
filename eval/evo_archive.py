"""Writes the archive that `evo_res` reads, so that our figures stand beside those of `evo_ape`."""

from pathlib import Path

import numpy as np
from evo.core.metrics import APE
from evo.core.result import Result
from evo.tools.file_interface import save_res_file  # leaves evo's settings in the home alone

from eval.files import atomic_path
from eval.trajectory import TrajectoryComparison

# As `evo_ape` calls them: `evo_res` compares only results of equal titles without a warning.
_TITLES = {
    "none": "(not aligned)",
    "first_pose": "(with origin alignment)",
    "se3": "(with SE(3) Umeyama alignment)",
    "sim3": "(with Sim(3) Umeyama alignment)",
    "yaw": "(with yaw and translation alignment)",
}


def write_evo_archive(path: Path, comparison: TrajectoryComparison) -> None:
    """Write position errors as the zip that ``evo_ape --save_results`` would write.

    It holds JSON and arrays in NumPy's format, no pickles.
    """
    with atomic_path(path) as temporary:
        save_res_file(str(temporary), _result(comparison))


def _result(comparison: TrajectoryComparison) -> Result:
    alignment, pairs = comparison.alignment, comparison.pairs
    metric = APE()
    metric.error = comparison.errors
    names = pairs.reference.name or "reference", pairs.estimate.name or "estimate"
    result = metric.get_result(*names)
    result.add_info({"title": f"{metric}\n{_TITLES[alignment.method]}"})
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = alignment.scale * alignment.R, alignment.t
    result.add_np_array("alignment_transformation_sim3", T)
    result.add_np_array("distances_from_start", comparison.distances)
    result.add_np_array("distances", comparison.estimate.distances)
    if pairs.stamped:
        result.add_np_array("timestamps", comparison.estimate.timestamps)
        result.add_np_array("seconds_from_start", comparison.seconds)
    return result
