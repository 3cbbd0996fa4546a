"""The page on the exact posterior, made from `posterior.json` by `posterior.py`."""

from __future__ import annotations

from typing import Any

READING = """\
The rows of a table are a sequence: the exact posterior's own mean and covariance, whose mean NEES
is the number of degrees of freedom whatever its shape; the same with the prior on 1/z that the
filters believe, which has mass at ω < 0; the Gaussian that Laplace puts at the mode of that; and
the filters. What each row adds to the one before is the cost of that step: of the prior, of not
being Gaussian, of recursion and linearisation."""

STAGES = {
    "exact": "exact posterior: its mean and covariance",
    "gaussian_prior": "… with the whole Gaussian prior on 1/z",
    "gaussian_prior_laplace": "… by MAP and Laplace",
}


def page(summary: dict[str, Any]) -> str:
    """The Markdown page: how to read it, the figure, then the tables."""
    hmc = summary["hmc"]
    parts = [
        "# The exact posterior, and how far the filters are from it",
        "Made by `python benchmarks/posterior.py`; do not edit. "
        f"{summary['runs']} runs with {summary['landmarks']} landmarks, seed {summary['seed']}, "
        f"float64; Hamiltonian Monte Carlo with {hmc['chains']} chains of {hmc['draws']} draws "
        f"after {hmc['warmup']}; MAP from {summary['starts']} "
        "starts. A row is over the runs of which both posteriors converged (R̂ ≤ 1.05 and 100 "
        "effective draws of pose, velocity and density). All rows of a scenario and step are of "
        "the same runs.",
        READING,
        "![Draws of one run, NEES and σ](posterior.png)",
    ]
    for scenario, by_step in summary["scenarios"].items():
        for steps, numbers in by_step.items():
            parts += [f"## `{scenario}`, step {steps}", *_section(numbers)]
    return "\n\n".join(parts) + "\n"


def _section(numbers: dict[str, Any]) -> list[str]:
    if "nees" not in numbers:
        return [_not_converged(numbers)]
    sampler, minima = numbers["sampler"]["exact"], numbers["minima"]["gaussian_prior"]
    low, high = numbers["nees"]["exact"]["band95"]
    calibration = numbers["calibration"]
    sigma, rmse = numbers["sigma"]["exact"], numbers["rmse"]
    p = ", ".join(
        f"{name} {value:.2f}"
        for name, value in zip(calibration["names"], calibration["p"], strict=True)
    )
    return [
        f"{numbers['used']} of {numbers['runs']} runs converged (median R̂ "
        f"{sampler['rhat_median']:.3f}, median effective draws {sampler['ess_median']:.0f}, "
        f"{sampler['divergent']:.1%} of the transitions divergent, {sampler['leapfrogs']:.0f} "
        f"leapfrog steps a draw). Exact σ (median): {1000 * sigma['position']:.1f} mm and "
        f"{1000 * sigma['orientation']:.2f} mrad. RMSE of its mean: {1000 * rmse['position']:.1f} "
        f"mm and {1000 * rmse['orientation']:.2f} mrad. Ranks of the truth uniform, p: {p}. "
        f"Several minima of the MAP in {minima['runs_with_several']:.0%} of the runs; the start at "
        f"the prior mean misses the best in {minima['prior_mean_missed_best']:.0%}.",
        "\n".join(_rows(numbers, (low, high))),
    ]


def _not_converged(numbers: dict[str, Any]) -> str:
    sampler = numbers["sampler"]["exact"]
    return (
        f"Only {numbers['used']} of {numbers['runs']} runs converged (median R̂ "
        f"{sampler['rhat_median']:.2f}, median effective draws {sampler['ess_median']:.0f}, "
        f"{sampler['divergent']:.1%} of the transitions divergent): the draws are not the "
        "posterior's, and nothing is compared with them."
    )


def _rows(numbers: dict[str, Any], band: tuple[float, float]) -> list[str]:
    lines = [
        f"| | NEES, mean ± s.e. (band {band[0]:.2f}–{band[1]:.2f}) | median | lost | σ/exact "
        "position, orientation | RMSE/exact position, orientation | KL median, mean | W₁/σ |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for key, name in STAGES.items():
        rest = "– | – | – | –"
        if key == "exact":
            rest = "1, 1 | 1, 1 | – | –"
        elif key == "gaussian_prior_laplace":
            rest = f"{_ratios(numbers['laplace'])} | – | –"
        lines.append(f"| {name} | {_nees(numbers['nees'][key])} | {rest} |")
    for name, f in numbers["filters"].items():
        kl = f"{_number(f['kl']['median'])}, {_number(f['kl']['mean'])}"
        distances = ", ".join(_number(value) for value in f["wasserstein"])
        lines.append(f"| {name} | {_nees(f['nees'])} | {_ratios(f)} | {kl} | {distances} |")
    return lines


def _nees(nees: dict[str, Any]) -> str:
    return (
        f"{_number(nees['mean'])} ± {_number(nees['standard_error'])} | "
        f"{_number(nees['median'])} | {nees['lost']:.1%}"
    )


def _ratios(numbers: dict[str, Any]) -> str:
    position, orientation = numbers["position"], numbers["orientation"]
    return " | ".join(
        f"{_number(position[key])}, {_number(orientation[key])}"
        for key in ("sigma_ratio", "rmse_ratio")
    )


def _number(value: float | None) -> str:
    if value is None:
        return "–"
    return f"{value:.1e}" if abs(value) >= 1e4 else f"{value:.3g}"
