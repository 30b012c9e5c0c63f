"""Force samples of a cannulation against a normal distribution, as published.

The publication compares force samples of a manual cannulation of the brachiocephalic
artery with a normal distribution that was fitted to a load cell under a phantom:
Shapiro–Wilk, Levene, Mann–Whitney, density and cumulative plots. A large p-value does
not prove equality, so `compare` adds effect sizes and an equivalence test.
"""

from typing import Any

import numpy as np
from scipy import stats

from cathsim_dmc import bounds
from cathsim_dmc.recording.episode import Episode

# The experiment as a draft of the publication gives it; unverified.
REFERENCE_MEAN = 0.4  # N
REFERENCE_SD = 0.02  # N
# Means closer than this count as equal, N: half the width of the range of 0 to 0.2 N of
# most forces in navigation.
EQUIVALENCE_MARGIN = 0.1
SIGNIFICANCE = 0.05
_SHAPIRO_LIMIT = 5_000  # most samples for which the p-value of Shapiro–Wilk holds
_LEAST_SAMPLES = 3


def load_cell_samples(episode: Episode) -> np.ndarray:
    """Readings of a load cell under the phantom in an episode.

    Returns:
        (n,) N, magnitudes of the resultant of all contact forces, in the control steps
        with contact.
    """
    total = np.zeros((episode.steps, 3))
    np.add.at(total, episode.contact_step, episode.contact_force)
    return np.linalg.norm(total[np.unique(episode.contact_step)], axis=-1)


def reference_sample(mean: float, sd: float, count: int) -> np.ndarray:
    """Sample (count,) of a normal distribution: its quantiles at (i + 1/2)/count."""
    return stats.norm.ppf((np.arange(count) + 0.5) / count, mean, sd)


def effective_count(samples: np.ndarray) -> float:
    """Effective sample size of a series (n,) for its mean.

    It is n over the integrated autocorrelation time, which is summed up to the first
    lag without positive autocorrelation.
    """
    n, centred = len(samples), samples - samples.mean()
    if not centred.any():
        return float(n)
    spectrum = np.abs(np.fft.rfft(centred, 2 * n)) ** 2
    correlation = np.fft.irfft(spectrum, 2 * n)[:n] / (centred @ centred)
    negative = np.flatnonzero(correlation <= 0)
    stop = int(negative[0]) if negative.size else n
    return float(max(1.0, n / (1 + 2 * correlation[1:stop].sum())))


def _enough(samples: np.ndarray) -> np.ndarray:
    """Samples (n,) as float64; ValueError if too few, or one is not finite."""
    samples = np.asarray(samples, dtype=np.float64)
    if samples.ndim != 1 or len(samples) < _LEAST_SAMPLES:
        raise ValueError(
            f"force samples of shape {samples.shape} are too few for statistics; give "
            f"{_LEAST_SAMPLES} or more, of an episode in which the device touches the "
            "wall"
        )
    if not np.isfinite(samples).all():
        raise ValueError("force samples hold NaN or infinite entries; leave them out")
    return samples


def compare(
    samples: np.ndarray,
    reference_mean: float = REFERENCE_MEAN,
    reference_sd: float = REFERENCE_SD,
    margin: float = EQUIVALENCE_MARGIN,
) -> dict[str, Any]:
    """Compares force samples with a normal reference of as many samples.

    Args:
        samples: (n,) N, in the order of time.
        reference_mean: Mean of the normal reference, N.
        reference_sd: Standard deviation of the reference, N.
        margin: Means closer than this count as equal, N.

    Returns:
        "count" n and "effective_count", see `effective_count`; "mean", "sd" (n - 1),
        "reference_mean", "reference_sd", N; "shapiro_w", "shapiro_p" of normality;
        "levene", "levene_p" of equal variances about the means; "mann_whitney_u",
        "mann_whitney_p" (two-sided) of equal distributions; "cliffs_delta",
        P(sample > reference) - P(sample < reference); "cohens_d", difference of the
        means over the pooled deviation; "margin" (N), "equivalence_p" of two one-sided
        Welch tests (Schuirmann, J. Pharmacokin. Biopharm. 15 (1987) 657) and
        "equivalent", whether the means are equal within the margin.

    Raises:
        ValueError: if there are too few samples, one is not finite, or a number is
            not positive.
    """
    samples = _enough(samples)
    bounds.number("reference_mean", reference_mean, low=0.0)
    for name, value in (("reference_sd", reference_sd), ("margin", margin)):
        bounds.number(name, value, positive=True)
    count = len(samples)
    reference = reference_sample(reference_mean, reference_sd, count)
    shapiro = stats.shapiro(samples[:: int(np.ceil(count / _SHAPIRO_LIMIT))])
    levene = stats.levene(samples, reference, center="mean")
    ranks = stats.mannwhitneyu(samples, reference, alternative="two-sided")
    mean, sd = float(samples.mean()), float(samples.std(ddof=1))
    independent = effective_count(samples)
    sides = [
        stats.ttest_ind_from_stats(
            mean + shift, sd, independent, reference_mean, reference_sd, count,
            equal_var=False, alternative=side,
        )
        for shift, side in ((margin, "greater"), (-margin, "less"))
    ]  # fmt: skip
    p_value = float(max(side.pvalue for side in sides))
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
        "cohens_d": (mean - reference_mean) / np.hypot(sd, reference_sd) * 2**0.5,
        "margin": float(margin),
        "equivalence_p": p_value,
        "equivalent": p_value < SIGNIFICANCE,
    }


def figure(samples: np.ndarray, comparison: dict[str, Any]) -> Any:
    """Density and cumulative plot of samples (n,) N beside the normal reference.

    Args:
        comparison: Result of `compare` for the samples.

    Returns:
        A matplotlib figure, which `style.save` writes.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from cathsim_dmc.style import COLOURS, tidy

    mean, sd = comparison["reference_mean"], comparison["reference_sd"]
    normal, ordered = stats.norm(mean, sd), np.sort(samples)
    # The kernel density is mirrored at zero, so that none of it lies below.
    width = max(1.06 * samples.std(ddof=1) * len(samples) ** -0.2, 1e-4)
    end = 1.05 * max(float(ordered[-1]), mean + 4 * sd)
    grid = np.union1d(np.linspace(0.0, end, 1_000), normal.ppf([0.001, 0.5, 0.999]))
    both = np.concatenate([ordered, -ordered])
    kernel = stats.norm.pdf((grid[:, None] - both) / width).sum(axis=1)
    density = kernel / (width * len(ordered))
    drawn = Figure(figsize=(9.0, 3.4), layout="constrained")
    FigureCanvasAgg(drawn)
    left, right = drawn.subplots(1, 2)
    ours = f"episode, n = {comparison['count']}"
    theirs = f"normal, {mean:g} ± {sd:g} N"
    left.fill_between(grid, density, color=COLOURS[0], alpha=0.25, lw=0)
    left.plot(grid, density, color=COLOURS[0], label=ours)
    left.plot(grid, normal.pdf(grid), color=COLOURS[1], label=theirs)
    top = 2.0 * max(density.max(), normal.pdf(mean))
    left.set(title="Density", xlabel="force on the phantom, N", ylabel="1/N")
    left.set(yscale="log", ylim=(1e-5 * top, top), xlim=(0.0, end))
    steps = np.arange(len(ordered) + 2.0).clip(max=len(ordered)) / len(ordered)
    places = [0.0, *ordered, end]
    right.step(places, steps, where="post", color=COLOURS[0], label=ours)
    right.plot(grid, normal.cdf(grid), color=COLOURS[1], label=theirs)
    right.set(title="Cumulative", xlabel="force on the phantom, N", xlim=(0.0, end))
    right.set(ylabel="share of the samples")
    for axes in (left, right):
        tidy(axes)
        axes.legend(frameon=False, fontsize=8, loc="center")
    return drawn
