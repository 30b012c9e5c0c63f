"""The published comparison of wall forces with a normal reference, and more.

The publication compares force samples of a manual cannulation of the brachiocephalic
artery with a normal distribution that was fitted to a load cell under a phantom:
Shapiro-Wilk, Levene, Mann-Whitney U, density and cumulative plots. A large p-value of
these proves no equality, so effect sizes and an equivalence test stand beside them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import stats

from cathsim_dmc.recording.episode import Episode

# The experiment as a draft of the publication gives it; unverified.
REFERENCE_MEAN = 0.4  # N
REFERENCE_SD = 0.02  # N
# Means closer than this count as equal, N: half the width of the range of 0 to 0.2 N
# in which most forces of navigation lie.
EQUIVALENCE_MARGIN = 0.1
SIGNIFICANCE = 0.05
# Shapiro-Wilk's p-value holds up to so many samples.
_SHAPIRO_LIMIT = 5000
_LEAST_SAMPLES = 3


def load_cell_samples(episode: Episode) -> np.ndarray:
    """What a load cell under the phantom reads in an episode, N.

    Returns:
        (n,) magnitudes of the resultant of all contact forces, of the control steps
        with contact.
    """
    total = np.zeros((episode.steps, 3))
    np.add.at(total, episode.contact_step, episode.contact_force)
    touched = np.unique(episode.contact_step)
    return np.linalg.norm(total[touched], axis=-1)


def reference_sample(mean: float, sd: float, count: int) -> np.ndarray:
    """A sample (count,) of a normal distribution: its quantiles at (i + 1/2)/n."""
    return stats.norm.ppf((np.arange(count) + 0.5) / count, mean, sd)


def effective_count(samples: np.ndarray) -> float:
    """Number of independent samples in a time series (n,).

    n over the integrated autocorrelation time, summed up to the first lag at which
    the autocorrelation is not positive.
    """
    n = len(samples)
    centred = samples - samples.mean()
    variance = centred @ centred
    if variance == 0:
        return float(n)
    size = 2 ** int(np.ceil(np.log2(2 * n)))
    spectrum = np.abs(np.fft.rfft(centred, size)) ** 2
    correlation = np.fft.irfft(spectrum, size)[:n] / variance
    negative = np.flatnonzero(correlation <= 0)
    stop = int(negative[0]) if negative.size else n
    return float(max(1.0, n / (1 + 2 * correlation[1:stop].sum())))


def equivalence(
    mean: float,
    sd: float,
    count: float,
    reference_mean: float,
    reference_sd: float,
    reference_count: float,
    margin: float,
) -> float:
    """p-value of two one-sided Welch tests of |difference of means| < margin.

    Schuirmann, J. Pharmacokin. Biopharm. 15 (1987) 657. Counts may be effective ones.
    """
    parts = sd**2 / count, reference_sd**2 / reference_count
    error = np.sqrt(sum(parts))
    difference = mean - reference_mean
    if error == 0:
        return float(abs(difference) >= margin)
    freedom = error**4 / sum(
        part**2 / max(n - 1, 1e-9)
        for part, n in zip(parts, (count, reference_count), strict=True)
    )
    lower = stats.t.sf((difference + margin) / error, freedom)
    upper = stats.t.cdf((difference - margin) / error, freedom)
    return float(max(lower, upper))


def compare(
    samples: np.ndarray,
    reference_mean: float = REFERENCE_MEAN,
    reference_sd: float = REFERENCE_SD,
    margin: float = EQUIVALENCE_MARGIN,
) -> dict[str, Any]:
    """Compares force samples (n,), in N and in the order of time, with a reference.

    The reference has as many samples as there are.

    Returns:
        "count" n and "effective_count", that of independent samples that tell as much
        of the mean; "mean", "sd" (n - 1), "reference_mean", "reference_sd", N;
        "shapiro_w", "shapiro_p" of normality; "levene", "levene_p" of equal variances
        about the means; "mann_whitney_u", "mann_whitney_p" (two-sided) of equal
        distributions; "cliffs_delta", P(sample > reference) - P(sample < reference);
        "cohens_d", difference of the means over the pooled deviation; "margin" (N) and
        "equivalence_p" of the two one-sided tests; "equivalent", whether the means are
        equal within the margin.

    Raises:
        ValueError: if there are too few samples, one is not finite, or an argument is
            not positive.
    """
    samples = np.asarray(samples, dtype=np.float64)
    if samples.ndim != 1 or len(samples) < _LEAST_SAMPLES:
        raise ValueError(
            f"{samples.shape} force samples are too few for statistics; give at least "
            f"{_LEAST_SAMPLES}, from an episode in which the device touches the wall"
        )
    if not np.isfinite(samples).all():
        raise ValueError("force samples hold NaN or infinite entries")
    for name, value in (("reference_sd", reference_sd), ("margin", margin)):
        if not value > 0:
            raise ValueError(f"{name} is {value} N; it must be positive")
    count = len(samples)
    reference = reference_sample(reference_mean, reference_sd, count)
    thinned = samples[:: int(np.ceil(count / _SHAPIRO_LIMIT))]
    shapiro = stats.shapiro(thinned)
    levene = stats.levene(samples, reference, center="mean")
    ranks = stats.mannwhitneyu(samples, reference, alternative="two-sided")
    mean, sd = float(samples.mean()), float(samples.std(ddof=1))
    independent = effective_count(samples)
    p_value = equivalence(
        mean, sd, independent, reference_mean, reference_sd, count, margin
    )
    pooled = np.sqrt((sd**2 + reference_sd**2) / 2)
    return {
        "count": count,
        "effective_count": independent,
        "mean": mean,
        "sd": sd,
        "reference_mean": float(reference_mean),
        "reference_sd": float(reference_sd),
        "shapiro_w": float(shapiro.statistic),
        "shapiro_p": float(shapiro.pvalue),
        "levene": float(levene.statistic),
        "levene_p": float(levene.pvalue),
        "mann_whitney_u": float(ranks.statistic),
        "mann_whitney_p": float(ranks.pvalue),
        "cliffs_delta": float(2 * ranks.statistic / count**2 - 1),
        "cohens_d": float((mean - reference_mean) / pooled),
        "margin": float(margin),
        "equivalence_p": p_value,
        "equivalent": bool(p_value < SIGNIFICANCE),
    }
