"""The statistics that accuracy is stated with: NEES, medians and RMSE, each beside its two-sided 95 % interval.

Intervals take the errors for independent of each other unless an effective number of degrees of freedom is given.
Images of one block are not independent: true intervals are then wider, and a mean just outside proves little.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import binom, chi2

from georef.geometry.rigid import Array

_TAILS = (0.025, 0.975)

Interval = tuple[float, float]


@dataclass(frozen=True)
class NeesSummary:
    """Normalised estimation error squared over its degrees of freedom: 1 where covariances are true.

    Above the interval they are too small (overconfident), below it too large.
    """

    count: int  # errors that have a covariance
    dof: int  # degrees of freedom of one error
    mean_ratio: float | None  # mean NEES / dof; None without errors
    interval: Interval | None  # two-sided 95 % of mean_ratio, were the covariances true
    effective_dof: float | None = None  # of the whole mean: count times dof, less where the errors are correlated

    @property
    def consistent(self) -> bool | None:
        """Whether the mean lies inside its interval; None without errors."""
        if self.mean_ratio is None or self.interval is None:
            return None
        return self.interval[0] <= self.mean_ratio <= self.interval[1]

    def to_dict(self) -> dict[str, object]:
        """Plain values for JSON."""
        return {
            "count": self.count,
            "dof": self.dof,
            "mean_ratio": finite(self.mean_ratio),
            "interval_95": finite_list(self.interval),
            "effective_dof": finite(self.effective_dof),
            "consistent": self.consistent,
        }


def nees(error: Array, cov: Array) -> float:
    """error' cov^-1 error of an error (k,) and its covariance (k, k), which must be positive definite.

    Bar-Shalom, Li, Kirubarajan, "Estimation with applications to tracking and navigation" (2001), section 5.4.
    Raises ValueError where the covariance is not positive definite.
    """
    scale = np.sqrt(np.diag(cov))  # radians and metres differ by orders of magnitude
    try:
        factor = np.linalg.cholesky(cov / np.outer(scale, scale))
    except np.linalg.LinAlgError:
        raise ValueError("the covariance of an error must be positive definite") from None
    return float(np.sum(np.square(np.linalg.solve(factor, error / scale))))


def summarize_nees(values: Iterable[float | None], dof: int, *, effective_dof: float | None = None) -> NeesSummary:
    """Mean NEES / dof of errors of `dof` degrees of freedom each; None (no covariance) is left out of the count.

    The sum of N independent values is chi-square with N dof degrees of freedom where the covariances are true; the
    mean of correlated ones scatters like that of effective_dof (see `effective_dof`).
    """
    known = [value for value in values if value is not None]
    if not known:
        return NeesSummary(0, dof, None, None)
    total = len(known) * dof
    effective = float(total) if effective_dof is None else effective_dof
    low, high = (float(chi2.ppf(tail, effective)) / effective for tail in _TAILS)
    return NeesSummary(len(known), dof, float(np.sum(known)) / total, (low, high), effective)


def effective_dof(joint_cov: Array, dof: int) -> float:
    """Degrees of freedom of a chi-square with the scatter of the mean NEES of correlated errors.

    joint_cov (N dof, N dof) of N errors, positive definite. With R = W C W', W whitening each error alone, the sum of
    the NEES has the variance 2 |R|^2: (N dof)^2 / |R|^2 (Satterthwaite), N dof where the errors are independent.
    """
    count = len(joint_cov) // dof
    blocks = [joint_cov[dof * i : dof * (i + 1), dof * i : dof * (i + 1)] for i in range(count)]
    whiteners = np.linalg.inv(np.linalg.cholesky(np.array(blocks)))
    whitened = np.einsum("iab,ibjc->iajc", whiteners, joint_cov.reshape(count, dof, count, dof))
    whitened = np.einsum("iajc,jdc->iajd", whitened, whiteners)
    return (count * dof) ** 2 / float(np.sum(np.square(whitened)))


def median_interval(values: ArrayLike) -> Interval | None:
    """95 % interval of the median of values (N,), which may be infinite; None for fewer than 6.

    Order statistics k and N + 1 - k with k the 2.5 % quantile of Binomial(N, 1/2): at least 95 % for any distribution.
    David and Nagaraja, "Order statistics" (2003), section 7.1.
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64))
    rank = int(binom.ppf(_TAILS[0], len(ordered), 0.5)) if len(ordered) else 0
    return (float(ordered[rank - 1]), float(ordered[-rank])) if rank >= 1 else None


def wilson_interval(count: int, total: int) -> Interval | None:
    """95 % interval of a share, in percent, of which `count` of `total` were observed; None for no trials.

    Wilson (1927): the shares p with |count / total - p| <= z sqrt(p (1 - p) / total).
    """
    if total == 0:
        return None
    share, z2 = count / total, float(chi2.ppf(_TAILS[1] - _TAILS[0], 1))
    middle = share + z2 / (2 * total)
    half = np.sqrt(z2 * (share * (1.0 - share) / total + z2 / (4.0 * total * total)))
    low, high = (100.0 * float((middle + sign * half) / (1.0 + z2 / total)) for sign in (-1.0, 1.0))
    return max(low, 0.0), min(high, 100.0)


def rmse_interval(errors: Array) -> Interval | None:
    """95 % interval of the root mean square length of errors (N, k); None without errors.

    Exact for k = 1 and normal errors without bias: chi-square with N degrees of freedom. For k > 1 approximate: with M
    the mean of e e', the sum of squares is taken for chi-square with N tr(M)^2 / tr(M^2) degrees of freedom
    (Satterthwaite 1946; Box 1954), between N and k N.
    """
    if len(errors) == 0:
        return None
    moment = errors.T @ errors / len(errors)
    trace = float(np.trace(moment))
    if trace == 0.0:
        return 0.0, 0.0
    dof = len(errors) * trace**2 / float(np.sum(np.square(moment)))
    low, high = (float(np.sqrt(trace * dof / chi2.ppf(tail, dof))) for tail in reversed(_TAILS))
    return low, high


def finite(value: float | None) -> float | None:
    """The value as JSON can hold it: None for what is unknown, infinite or not a number."""
    return float(value) if value is not None and np.isfinite(value) else None


def finite_list(values: Sequence[float] | Array | None) -> list[float | None] | None:
    """The values as JSON can hold them; None stays None."""
    return None if values is None else [finite(float(value)) for value in values]
