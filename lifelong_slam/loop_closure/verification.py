"""Verification of a loop closure candidate by registration, and the reasons to reject one."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.registration import Cloud, Registration, register

Array = NDArray[np.float64]


class Verdict(StrEnum):
    """What became of a candidate."""

    ACCEPTED = "accepted"
    DIVERGED = "registration diverged"
    OVERLAP = "too little overlap"
    RESIDUAL = "surfaces do not meet"
    DEGENERATE = "geometry leaves a direction free"


@dataclass(frozen=True, slots=True)
class Verifier:
    """Registers a keyframe to a submap and judges the result.

    Attributes:
        voxel_size: metres, of the clouds and of the correspondences' reach.
        min_overlap: least fraction of the keyframe's points on surfaces of the submap.
        max_residual: greatest RMS distance of those from the surfaces, metres.
        min_degeneracy: least ratio of the weakest to the strongest direction of translation.
    """

    voxel_size: float
    min_overlap: float = 0.5
    max_residual: float = 0.06
    min_degeneracy: float = 0.01

    def verify(
        self, target: Array, source: Cloud, guesses: Sequence[Array]
    ) -> tuple[Verdict, Registration]:
        """Register `source` to (N, 3) `target` points from guesses of T_target_source."""
        registration = register(
            Cloud.prepare(target, self.voxel_size), source, guesses, self.voxel_size
        )
        return self._judge(registration), registration

    def _judge(self, registration: Registration) -> Verdict:
        if not registration.converged:
            return Verdict.DIVERGED
        if registration.overlap < self.min_overlap:
            return Verdict.OVERLAP
        if registration.residual > self.max_residual:
            return Verdict.RESIDUAL
        if registration.degeneracy < self.min_degeneracy:
            return Verdict.DEGENERATE
        return Verdict.ACCEPTED
