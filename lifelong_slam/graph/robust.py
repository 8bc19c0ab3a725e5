"""Which loop closures are true: a choice among them, and the poses that follow from it.

The objective is that of truncated least squares with the covariances' common scale unknown. With d
degrees of freedom a closure and n = d times the number of accepted ones, it is the least value over
s^2, from 1/9 to 9, of

    (chi^2 + v) / s^2 + (n + v) log s^2 - v + t * (number of rejected closures).

chi^2 is the sum over all edges in use at the optimum. t is the 0.999 quantile of the chi-square
distribution with d degrees of freedom: what a closure may cost all edges together and still be true. s is
the factor by which stated standard deviations are too small, the variance of unit weight in the adjustment
of geodetic networks (Baarda, *A testing procedure for use in geodetic networks*, 1968). Where hundreds of
closures agree to a seventh of what they claim, one that costs as much as it claims is wrong; and where
odometry is three times as sure as it should be, the true ones still come in. Before data tell otherwise s
is 1: that counts for v = 30 degrees of freedom. Edges that are composed of others tell nothing of s, as
what their parts disagreed about is gone; where there are some, s stays 1.

What is assumed: odometry is right but for its scale, errors are Gaussian, and wrong closures don't agree
with each other in greater number than the true ones that contradict them.

The choice is found by descent. Given an optimum, the change of chi^2 by adding or dropping one closure has
a closed form, e^T (C + P)^-1 e and r^T (C - P)^-1 r, with e and r its residual, C its covariance and P that
of its prediction by all that is in use. Steps are

- adding closures, those first that can be judged most surely, with the least P (short loops before
  long ones, as in Olivastri and Pretto, *IPC: incremental probabilistic consensus*, 2024);
- dropping those whose loss makes the objective fall most;
- adding a group that agrees given one of its members (pairwise consistency as in Mangelson et al.,
  *Pairwise consistent measurement set maximization*, ICRA 2018, but conditional on all that is accepted);
- going over to a better optimum of the same choice, from the chordal relaxation.

Each step is verified by a nonlinear optimisation, and undone where the objective doesn't fall.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TypeAlias

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from lifelong_slam.graph.closure_problem import ClosureProblem, Linearised

Array = NDArray[np.float64]

INLIER_PROBABILITY = 0.999  # share of true closures that cost less than the threshold
MOST_SCALE = 3.0  # by which stated standard deviations are believed to be off, either way
PRIOR_DOF = 30.0  # that the stated standard deviations themselves count for

_ALIKE = 6.0  # in log det: closures that can be judged about as surely are added together,
_AT_ONCE = 0.05  # and at first at least this share of those that fit
_SEEDS = 400  # closures at most that groups are looked for around
_MEMBERS = 64  # of a group at most; single steps add the others
_TRIALS = 3  # steps of a kind at most that are tried before a choice counts as the best
_RIVALS = 1  # groups at most that are held against the best choice
_ALLIES = 3  # closures that make such a group; two agree by chance
_LEAST_GAIN = 1e-3  # in the objective; less is rounding
_FEW = 128  # closures that are looked at exactly at once
_ROUGHLY = 1.3  # by which a sampled covariance may be off
_LEFT_OPEN = 0.01  # share of a closure's variance that draws can tell to be left open
_HELD = 1e-9  # share of a closure's variance that the others leave open at least


def threshold(dof: int) -> float:
    """Return what a true closure costs at most, in chi-square."""
    return float(chi2.ppf(INLIER_PROBABILITY, dof))


def objective(
    chi_square: Array, accepted: Array, rejected: Array, dof: int, scaled: bool = True
) -> Array:
    """Return what the vote minimises; see the top of this file.

    Args:
        chi_square: of all edges in use at their optimum.
        accepted: number of closures among them.
        rejected: number of closures that are left out.
        dof: degrees of freedom of a closure, 3 or 6.
        scaled: the scale of the covariances is unknown; else it is 1.
    """
    dims = dof * accepted + PRIOR_DOF
    fit = chi_square + PRIOR_DOF
    s2 = np.clip(fit / dims, MOST_SCALE**-2, MOST_SCALE**2) if scaled else np.ones(fit.shape)
    value: Array = fit / s2 + dims * np.log(s2) - PRIOR_DOF + threshold(dof) * rejected
    return value


def doubt_about(rejected: int, every: int) -> str | None:
    """Return what to say if more than half of all closures are rejected; perhaps it isn't they that err."""
    if 2 * rejected <= every:
        return None
    alone = ", and only odometry is left" if rejected == every else ""
    return (
        f"{rejected} of {every} loop closures are rejected{alone}; if most of them are true, odometry"
        " is less sure than it claims to be"
    )


@dataclass(frozen=True, slots=True)
class Choice:
    """A choice of closures at its optimum.

    Attributes:
        accepted: indices of the closures that are in.
        values: poses.
        chi_square: of all that is in use.
        objective: see the top of this file.
    """

    accepted: frozenset[int]
    values: gtsam.Values
    chi_square: float
    objective: float


Start: TypeAlias = tuple[Iterable[int], gtsam.Values]


def vote(problem: ClosureProblem, starts: Iterable[Start]) -> Choice:
    """Return the best choice of closures that descent finds.

    Descent begins with the first start, and then with each other one that is better than what was found
    by then. A choice in which all closures are in, and fit as well as they claim to, needs no rival.

    Args:
        problem: trusted edges and closures.
        starts: choices to begin with, by index, and the poses to solve them from.
    """
    search = _Search(problem)
    begun = [search.glance(frozenset(accepted), values) for accepted, values in starts]
    best = begun[0]
    for choice in sorted(begun, key=search.is_perfect, reverse=True):
        if choice is begun[0] or choice.objective < best.objective or search.is_perfect(choice):
            best = min(best, search.descend(choice), key=lambda found: found.objective)
        if search.is_perfect(best):
            return best
    if len(begun) > 1:
        best = search.relaxed(best)
    return search.rivalled(best)


def fitted(problem: ClosureProblem, starts: Iterable[Start]) -> Choice:
    """Return the best of the given choices at their optima, without changing any."""
    search = _Search(problem)
    found = [search.choose(frozenset(accepted), values) for accepted, values in starts]
    return min(found, key=lambda choice: choice.objective)


class _Search:
    """Descent over choices of closures."""

    def __init__(self, problem: ClosureProblem) -> None:
        self._problem = problem
        self._all = np.arange(len(problem))
        self._limit = threshold(problem.dof)

    def choose(self, accepted: frozenset[int], start: gtsam.Values) -> Choice:
        """Optimise with some closures."""
        return self._choice(accepted, *self._problem.solve(accepted, start))

    def glance(self, accepted: frozenset[int], start: gtsam.Values) -> Choice:
        """Look whether a start is promising."""
        return self._choice(accepted, *self._problem.glance(accepted, start))

    def _choice(self, accepted: frozenset[int], values: gtsam.Values, chi_square: float) -> Choice:
        value = float(self._objective(chi_square, len(accepted)))
        return Choice(accepted, values, chi_square, value)

    def is_perfect(self, choice: Choice) -> bool:
        """Tell whether all closures are in and fit as well as they claim to."""
        everything = len(choice.accepted) == len(self._all)
        return everything and choice.chi_square <= self._problem.dof * len(self._all)

    def descend(self, choice: Choice) -> Choice:
        """Take steps until none makes the objective fall."""
        choice = self.choose(choice.accepted, choice.values)
        while True:
            choice = self._flipped(choice)
            better = self._with_group(choice)
            if better is None:
                return choice
            choice = better

    def relaxed(self, choice: Choice) -> Choice:
        """Go on from a better optimum of the same choice, if the chordal relaxation leads to one."""
        start = self._problem.relaxed(choice.accepted, choice.values)
        better = self.choose(choice.accepted, start)
        return self.descend(better) if better.objective < choice.objective - _LEAST_GAIN else choice

    def rivalled(self, best: Choice) -> Choice:
        """Return a better choice with closures that agree with each other and not with the best.

        What came first may have closed the door to them.
        """
        nothing = self.choose(frozenset(), best.values)
        for group in self._groups(nothing, among=~self._mask(best))[:_RIVALS]:
            rival = self._upheld(best, group) if len(group) >= _ALLIES else None
            if rival and rival.objective < best.objective:
                best = rival
        return best

    def _upheld(self, best: Choice, group: frozenset[int]) -> Choice | None:
        """Return what descent makes of a group and the best choice; None if it drops most of the group."""
        rival = self.choose(best.accepted | group, best.values)
        while 2 * len(rival.accepted & group) > len(group):
            around = self._problem.linearise(rival.accepted, rival.values)
            better = self._with_fewer(rival, around)
            if better is None:
                return self.descend(rival)
            rival = better
        return None

    def _objective(self, chi_square: Array | float, accepted: Array | int) -> Array:
        count = np.asarray(accepted)
        left_out = len(self._all) - count
        scaled = self._problem.measured
        return objective(np.asarray(chi_square), count, left_out, self._problem.dof, scaled)

    def _flipped(self, choice: Choice) -> Choice:
        """Add and drop closures until no single one makes the objective fall."""
        at_once = _AT_ONCE
        while True:
            around = self._problem.linearise(choice.accepted, choice.values)
            better = self._with_fewer(choice, around)
            at_once = _AT_ONCE if better else 2 * at_once  # as long as nothing is regretted
            better = better or self._with_more(choice, around, min(at_once, 1.0))
            if better is None:
                return choice
            choice = better

    def _with_fewer(self, choice: Choice, around: Linearised) -> Choice | None:
        """Drop the closures whose loss makes the objective fall most."""
        flips = self._flips(choice, around, self._mask(choice), -1)
        if not len(flips.closures):
            return None
        fall = choice.objective - flips.objective
        worst = np.argsort(-fall)[: np.count_nonzero(2 * fall > fall.max())]
        return self._first_better(choice, flips.closures[worst], choice.accepted.difference)

    def _with_more(self, choice: Choice, around: Linearised, at_once: float) -> Choice | None:
        """Add closures, of those that would make the objective fall the ones that can be judged best.

        Args:
            choice: to add to.
            around: it.
            at_once: share of those closures that are added at least.
        """
        flips = self._flips(choice, around, ~self._mask(choice), 1)
        if not len(flips.closures):
            return None
        alike = flips.doubt <= max(flips.doubt.min() + _ALIKE, np.quantile(flips.doubt, at_once))
        batch = flips.closures[alike][np.argsort(flips.objective[alike])]
        return self._first_better(choice, batch, choice.accepted.union)

    def _first_better(
        self,
        choice: Choice,
        batch: NDArray[np.int64],
        flipped: Callable[[list[int]], frozenset[int]],
    ) -> Choice | None:
        """Flip a batch, or only its first half and so on, until the objective falls."""
        while len(batch):
            new = self.choose(flipped(batch.tolist()), choice.values)
            if new.objective < choice.objective - _LEAST_GAIN:
                return new
            batch = batch[: len(batch) // 2]
        return None

    def _mask(self, choice: Choice) -> NDArray[np.bool_]:
        return np.isin(self._all, list(choice.accepted))

    def _flips(
        self, choice: Choice, around: Linearised, asked: NDArray[np.bool_], sign: int
    ) -> "_Flips":
        """Return those closures that make the objective fall when added (1) or dropped (-1).

        Where there are many, covariances are estimated from random draws first. What is to be added needs
        no more, as it is verified; what is to be dropped is judged by the small share of its variance that
        the others leave open, so that draws only tell which to look at exactly.
        """
        closures = self._all[asked]
        if len(closures) > _FEW:
            r, spread = around.residuals[closures], around.sampled_spread[closures]
            flips = self._falling(choice, closures, *_change(r, spread, sign), sign)
            if sign > 0 and len(flips.closures) > _FEW:
                return flips
            change, _ = _change(r, _ROUGHLY * spread, sign, least=_LEFT_OPEN)
            closures = closures[np.argsort(change, kind="stable")[:_FEW]]
        if not len(closures):
            return _Flips(closures, np.zeros(0), np.zeros(0))
        change, doubt = _change(around.residuals[closures], around.spread(closures), sign)
        return self._falling(choice, closures, change, doubt, sign)

    def _falling(
        self,
        choice: Choice,
        closures: NDArray[np.int64],
        change: Array,
        doubt: Array,
        sign: int,
    ) -> "_Flips":
        """Return those of the closures whose change of chi-square makes the objective fall."""
        value = self._objective(choice.chi_square + change, len(choice.accepted) + sign)
        falls = value < choice.objective - _LEAST_GAIN
        return _Flips(closures[falls], value[falls], doubt[falls])

    def _with_group(self, choice: Choice) -> Choice | None:
        """Add closures that agree with each other, though each alone costs too much."""
        for group in self._groups(choice, among=~self._mask(choice))[:_TRIALS]:
            better = self._flipped(self.choose(choice.accepted | group, choice.values))
            if better.objective < choice.objective - _LEAST_GAIN:
                return better
        return None

    def _groups(self, choice: Choice, among: NDArray[np.bool_]) -> list[frozenset[int]]:
        """Return distinct groups of closures that agree given one of them, the most promising first.

        Args:
            choice: that they are to be added to.
            among: (K,) which closures may be members; none that is in.
        """
        closures = self._all[among]
        if len(closures) < 2:
            return []
        around = self._problem.linearise(choice.accepted, choice.values)
        if len(closures) > _SEEDS:
            change, _ = _change(around.residuals, around.sampled_spread, 1)
            closures = np.sort(closures[np.argsort(change[closures], kind="stable")[:_SEEDS]])
        e, Q = around.residuals[closures], around.joint_spread(closures)
        found: list[tuple[float, frozenset[int]]] = []
        for seed in range(len(closures)):
            members, cost = _agreeing(seed, e, Q, self._limit)
            after = len(choice.accepted) + len(members)
            value = float(self._objective(choice.chi_square + cost, after))
            if len(members) > 1 and value < choice.objective:
                found.append((value, frozenset(closures[members].tolist())))
        return _distinct([group for _, group in sorted(found, key=lambda pair: pair[0])])


def _distinct(groups: Iterable[frozenset[int]]) -> list[frozenset[int]]:
    """Return those groups of which earlier ones have no more than half."""
    distinct: list[frozenset[int]] = []
    for group in groups:
        if all(2 * len(group & other) <= len(group) for other in distinct):
            distinct.append(group)
    return distinct


@dataclass(frozen=True, slots=True)
class _Flips:
    """Single closures to add or drop: (n,) indices, objectives after, and log determinants of doubt."""

    closures: NDArray[np.int64]
    objective: Array
    doubt: Array


def _change(
    residuals: Array, spread: Array, sign: int, least: float = _HELD
) -> tuple[Array, Array]:
    """Return the (n,) changes of chi-square by adding (1) or dropping (-1) closures, and their doubt.

    Args:
        residuals: (n, d) whitened.
        spread: (n, d, d) whitened covariances of the predictions.
        sign: which.
        least: eigenvalue of what is left open when one is dropped.
    """
    eigenvalues, V = np.linalg.eigh(np.eye(residuals.shape[1]) + sign * spread)
    # A closure that alone holds something leaves nothing to judge it by when it is dropped.
    eigenvalues = np.maximum(eigenvalues, least)
    along = np.einsum("nij,ni->nj", V, residuals)
    return sign * (along**2 / eigenvalues).sum(1), np.log(eigenvalues).sum(1)


def _agreeing(seed: int, e: Array, Q: Array, limit: float) -> tuple[NDArray[np.int64], float]:
    """Return the closures that agree with a seed once it is accepted, and what all of them cost.

    Args:
        seed: index of the closure that is hypothetically true.
        e: (n, d) whitened residuals.
        Q: (n, n, d, d) whitened covariances among the predictions.
        limit: that one may cost, given those that agree better.
    """
    n, d = e.shape
    given = np.linalg.inv(np.eye(d) + Q[seed, seed])
    rest = e - Q[:, seed] @ (given @ e[seed])
    gain = Q[:, seed] @ given
    own = np.eye(d) + Q[np.arange(n), np.arange(n)] - gain @ Q[seed]
    cost = np.einsum("ni,ni->n", rest, np.linalg.solve(own, rest[..., None])[..., 0])
    cost[seed] = limit  # it is counted by itself
    members = np.argsort(cost, kind="stable")[: np.count_nonzero(cost < limit)][:_MEMBERS]
    joint = Q[np.ix_(members, members)] - gain[members, None] @ Q[seed, members]
    joint = joint.swapaxes(1, 2).reshape(len(members) * d, len(members) * d)
    try:
        root = np.linalg.cholesky((joint + joint.T) / 2 + np.eye(len(joint)))
    except np.linalg.LinAlgError:  # rounding, where the seed alone ties two parts together
        return np.array([seed]), 0.0
    steps = (np.linalg.solve(root, rest[members].ravel()).reshape(-1, d) ** 2).sum(1)
    fits = steps < limit
    total = e[seed] @ given @ e[seed] + steps[fits].sum()
    return np.append(members[fits], seed), float(total)
