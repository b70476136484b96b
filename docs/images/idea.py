"""Draw the idea of prbayes on the crack growth data: docs/images/idea.svg and idea_dark.svg.

Run: python docs/images/idea.py
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pymc as pm
from matplotlib.patches import FancyArrowPatch
from scipy.stats import gaussian_kde, lognorm

import prbayes as prb

FOLDER = Path(__file__).parent
THEMES = {
    "idea": {"ink": "#222222", "start": "#8a8a8a", "model": "#0072B2", "data": "#D55E00"},
    "idea_dark": {"ink": "#e0e0e0", "start": "#9a9a9a", "model": "#56B4E9", "data": "#F0955A"},
}


def growth(rate: Any, m: float = 2.6, million_cycles: float = 0.05) -> Any:
    """Return crack length over notch length; +inf where the specimen has failed."""
    left = 1 - (m - 1) * rate * million_cycles
    length = np.maximum(left, 1e-12) ** (-1 / (m - 1))
    return np.where(left > 0, length, np.inf)


def calibrate(lengths: Any) -> tuple[dict[str, float], Any]:
    """Return optimum and posterior draws, (n, 2), of the mean and the spread of log C."""
    with pm.Model():
        mu = pm.Normal("mu", 1.1, 0.5)
        sigma = pm.HalfNormal("sigma", 0.5)
        rate = pm.LogNormal.dist(mu, sigma)
        prb.Simulator("crack", growth, rate, metric=prb.ProbabilityResidual(), observed=lengths)
        optimum = prb.minimize(progressbar=False)
        posterior = prb.sample(optimum=optimum, random_seed=1, progressbar=False).posterior
    return optimum.point, np.stack([posterior[v].values.ravel() for v in ("mu", "sigma")], axis=-1)


def draw(theme: dict[str, str], lengths: Any, best: dict[str, float], draws: Any) -> plt.Figure:
    """Draw population, responses, comparison and estimates in a circle."""
    ink, start, model, data = theme.values()
    plt.rcParams |= {"text.color": ink, "axes.labelcolor": ink, "axes.edgecolor": ink}
    plt.rcParams |= {"font.size": 13, "svg.hashsalt": "idea", "xtick.color": ink}
    figure, axes = plt.subplots(2, 2, figsize=(6.4, 6.2))
    figure.subplots_adjust(left=0.07, right=0.98, bottom=0.1, top=0.93, wspace=0.5, hspace=0.72)
    population, responses, comparison, estimates = axes[0, 0], axes[0, 1], axes[1, 1], axes[1, 0]
    levels = (np.arange(4000) + 0.5) / 4000
    theta = (best["mu"], best["sigma"])
    first = (1.1, 0.5)  # the middle of the priors

    grid = np.linspace(1, 7, 120)
    for mu, sigma in draws[:: len(draws) // 25]:
        density = lognorm(sigma, scale=np.exp(mu)).pdf(grid)
        population.plot(grid, density, color=model, alpha=0.15, lw=1)
    z, fine = np.linspace(1.0, 1.55, 120), np.linspace(1.05, 1.5, 250)
    measured = np.searchsorted(np.sort(lengths), fine, side="right") / lengths.size
    for (mu, sigma), color, style in ((first, start, "--"), (theta, model, "-")):
        frozen = lognorm(sigma, scale=np.exp(mu))
        population.plot(grid, frozen.pdf(grid), color=color, ls=style, lw=2)
        values = growth(frozen.ppf(levels))
        kept = values[np.isfinite(values)]
        responses.plot(z, gaussian_kde(kept, 0.15)(z), color=color, ls=style, lw=2)
        predicted = np.searchsorted(np.sort(values), fine, side="right") / values.size
        comparison.fill_between(fine, measured, predicted, color=color, alpha=0.3, lw=0)
        comparison.plot(fine, predicted, color=color, ls=style, lw=2)
    responses.plot(lengths, np.full(lengths.size, -0.7), "|", color=data, ms=11, mew=1.6)
    responses.set(xlim=(1.0, 1.55), ylim=(-1.5, None))

    comparison.plot(fine, measured, color=data, lw=1.6)
    comparison.set(xlim=(1.05, 1.5), ylim=(0, 1.03))

    estimates.plot(*draws[::14].T, ".", color=model, ms=3, alpha=0.5)
    estimates.plot(*theta, "+", color=ink, ms=17, mew=2.5)
    estimates.set(xlim=(0.95, 1.35), ylim=(0.08, 0.4))

    for axis, title, label in (
        (population, "population of inputs", "C, differs by specimen"),
        (responses, "population of responses", "crack length, measured |"),
        (comparison, "metric or likelihood", "measured against predicted"),
        (estimates, "optimum and posterior", "mean, sd of log C; + optimum"),
    ):
        axis.set_title(title, fontsize=13, fontweight="bold")
        axis.set_xlabel(label, fontsize=12)
        axis.set(xticks=[], yticks=[], facecolor="none")
        axis.spines[["top", "right"]].set_visible(False)
    return connected(figure, ink)


def connected(figure: plt.Figure, ink: str) -> plt.Figure:
    """Draw the arrows between the panels."""
    for tail, head, text, place in (
        ((0.43, 0.75), (0.585, 0.75), "model\nS", (0.507, 0.815)),
        ((0.79, 0.535), (0.79, 0.455), "compare", (0.895, 0.495)),
        ((0.585, 0.26), (0.43, 0.26), "estimate", (0.507, 0.295)),
        ((0.25, 0.455), (0.25, 0.535), r"next $\theta$", (0.35, 0.495)),
    ):
        arrow = FancyArrowPatch(
            tail, head, arrowstyle="-|>", mutation_scale=18, lw=2, color=ink, shrinkA=0, shrinkB=0
        )
        figure.add_artist(arrow)
        figure.text(*place, text, ha="center", va="center", fontsize=13)
    return figure


def main() -> None:
    """Write both pictures."""
    data = prb.datasets.crack_growth()
    lengths = (data.crack_length_inch.sel(million_cycles=0.05) / data.notch_inch).values
    best, draws = calibrate(lengths)
    for name, theme in THEMES.items():
        figure = draw(theme, lengths, best, draws)
        path = FOLDER / f"{name}.svg"
        figure.savefig(path, transparent=True, metadata={"Date": None})
        lines = path.read_text(encoding="utf-8").splitlines()
        digits = re.compile(r"(?<=\.\d\d)\d+")
        shorter = [digits.sub("", s) if s[:2] in ("M ", "L ", "C ") else s for s in lines]
        path.write_text("\n".join(shorter), encoding="utf-8")
        plt.close(figure)


if __name__ == "__main__":
    main()
