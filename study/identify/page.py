"""The page of ``softgrasp identify``: values with their errors, what the data determine, and reasons against them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from softgrasp.fem.columns import labels
from softgrasp.fem.shown import counted, digits
from softgrasp.reduction.identify.result import Identified
from softgrasp.reduction.identify.verdict import BY_CHANCE, direction_in_words
from softgrasp.study.report import Section, Share, Table, captioned, in_words, of_scene, percent
from softgrasp.study.shell import Session
from softgrasp.study.shell.session import Page

CAPTIONS = {
    "fit.png": "Above: measured outputs (dots) and the fit (lines), of each experiment. Below: residuals over the "
    "stated standard deviation of the noise; the grey band contains 95 % of white noise.",
    "ellipses.png": "Pairs of values: change against the answer. Ellipses: 68 and 95 % of the noise. Lines to a dot: "
    "the answer without one of the other parts of its error; no dot: it lies outside.",
    "history.png": "Values after each round over the final ones; a round is a fit with one reduced model.",
}
ASSUMED_ERROR = 0.1
SHOWN_POWER = 0.01  # of the largest power of a combination: a small one of a value that is little known counts
ASSUMED = "Parameters that are not fitted are taken from the scene as exact; their errors come on top."


def compose(answer: Identified, session: Session, fitted: Path, options: str) -> Page:
    """Draw the pictures and compose the page."""
    drawn: list[Path] = []
    if session.pictures:
        from softgrasp.study.identify.plots import draw  # brings Matplotlib

        drawn += draw(answer, session.out)
    figures = captioned(drawn, CAPTIONS)
    sections = [
        Section("", figures=figures[:1]),
        of_scene(answer.scene),
        value_table(answer).section(
            f"Noise: standard deviation. {kinds_sentence(answer)} Errors are of the logarithm; signed parts are those "
            "of log(value / truth).",
            terminal=True, figures=figures[1:2],
        ),
        determined_table(answer).section("A combination with a deviation above 100 % is not determined by the data."),
        *([assumed_table(answer).section(ASSUMED, terminal=True)] if answer.assumed else []),
        *([nuisance_table(answer).section(terminal=True)] if answer.nuisances else []),
        *([posterior_table(answer).section(posterior_sentence(answer), terminal=True)] if answer.posterior else []),
        Section("Fit", rows=fit_rows(answer), figures=figures[2:], terminal=True),
    ]  # fmt: skip
    return Page(
        f"{answer.scene.name}: material from measurements", summary(answer), sections,
        {"values.csv": value_table(answer), "residuals.csv": residual_table(answer)}, [*drawn, fitted], options,
        errors=[error_sentence(answer)], warnings=[*answer.reasons, *answer.warnings],
    )  # fmt: skip


def kinds_sentence(answer: Identified) -> str:
    """How each part is known."""
    text = "; ".join(f"{name}: {how}" for name, how in answer.kinds.items())
    return f"{text[0].upper()}{text[1:]}."


def value_table(answer: Identified) -> Table:
    """Each value with the parts of its error."""
    header = ("parameter", "start", "value", "unit", "noise", *answer.parts, "together")
    rows = [
        (
            u.name, float(answer.start[i]), float(answer.values[i]), u.unit, Share(answer.noise[i]),
            *("not known" if part is None else Share(part[i]) for part in answer.parts.values()),
            Share(answer.total[i]),
        )
        for i, u in enumerate(answer.unknowns)
    ]  # fmt: skip
    return Table(header, rows, "Values and the parts of their errors")


def posterior_table(answer: Identified) -> Table:
    """Deviations by the covariance and by the samples."""
    found = answer.posterior
    assert found is not None
    rows = [
        (u.name, Share(answer.noise[i]), Share(found.deviations[i]), Share(found.mean[i]))
        for i, u in enumerate(answer.unknowns)
    ]
    return Table(("parameter", "noise by the covariance", "by the samples", "mean less the value"), rows, "Posterior")


def posterior_sentence(answer: Identified) -> str:
    """How many samples there are."""
    assert answer.posterior is not None
    return (
        f"{answer.posterior.count} samples by emcee, {answer.posterior.independent:.0f} of them independent: a check "
        "of the covariance. Both are of the noise alone."
    )


def determined_table(answer: Identified) -> Table:
    """What the data determine, the best first."""
    rows = [
        (direction_in_words(answer.unknowns, d, SHOWN_POWER), Share(1 / max(float(s), 1e-12)))
        for s, d in zip(answer.sensitivities, answer.directions, strict=True)
    ]
    return Table(("the data determine", "with a deviation of"), rows, "What the data determine")


def assumed_table(answer: Identified) -> Table:
    """What an error in a parameter that is not fitted does to the values, the largest first."""
    order = sorted(answer.assumed.items(), key=lambda each: -float(np.abs(each[1]).max()))
    rows = [(name, *(Share(round(ASSUMED_ERROR * x, 9) + 0.0) for x in change)) for name, change in order]
    return Table(("+10 % in", *(f"changes {u.name} by" for u in answer.unknowns)), rows, "What the values rest on")


def nuisance_table(answer: Identified) -> Table:
    """Offsets and time shifts."""
    parts = tuple(answer.nuisances[0].parts)
    rows = [
        (n.name, n.value, n.noise, *("not known" if n.parts[key] is None else n.parts[key] for key in parts), n.total)
        for n in answer.nuisances
    ]
    return Table(("fitted beside the material", "value", "noise", *parts, "together"), rows, "Markers and clocks")


def residual_table(answer: Identified) -> Table:
    """Measured and fitted outputs, empty where nothing was measured."""
    names = [f"{c.label} [{c.unit}]" for c in answer.columns]
    header = ("experiment", "time [s]", *names, *(f"fitted {name}" for name in names))
    rows = [
        (data.name, float(t), *(None if np.isnan(x) else float(x) for x in (*measured, *fitted)))
        for data, table in zip(answer.data, answer.fitted, strict=True)
        for t, measured, fitted in zip(data.times, data.values, table, strict=True)
    ]
    return Table(header, rows, "Residuals")


def fit_rows(answer: Identified) -> list[tuple[str, str]]:
    """How good the fit is, and what it cost."""
    r, k = answer.residuals, len(answer.unknowns)
    pairs = [
        f"{answer.unknowns[i].name} and {answer.unknowns[j].name} {answer.correlation[i, j]:+.2f}"
        for i in range(k)
        for j in range(i)
    ]
    seen = np.vstack([np.isfinite(data.values) for data in answer.data]).any(axis=0)
    names = [name for name, one in zip(labels(answer.columns), seen, strict=True) if one]
    return [
        ("numbers", f"{r.count} of {in_words(names)}, in {counted(len(answer.data), 'experiment')}"),
        ("mesh", f"n_e = {answer.model.system.layout.n_e}, {answer.scene.time.steps} time steps, those of fitted.toml"),
        ("misfit", f"{r.misfit:.4g} sigma, by chance at most {r.limit:.4g}"),
        ("white", f"correlation of neighbours {r.lag:+.2g}, probability by chance {max(r.white, 1e-15):.2g}"),
        ("outliers", f"{r.outliers} above 4 sigma"),
        *([("correlation", ", ".join(pairs))] if pairs else []),
        ("law", answer.law),
        ("work", f"{len(answer.history) - 1} rounds, {answer.runs} reduced runs, N = {answer.N}"),
    ]


def error_sentence(answer: Identified) -> str:
    """Values with all their errors together."""
    if answer.reasons:
        return "The answer is refused; do not use its values."
    values = [
        f"{u.name} = {digits(v)} {u.unit} with an error of about {percent(e)}"
        for u, v, e in zip(answer.unknowns, answer.values, answer.total, strict=True)
    ]
    return f"The data give {in_words(values)}."


def summary(answer: Identified) -> list[str]:
    """What came out, in some sentences."""
    r = answer.residuals
    size = "no larger than the noise" if r.misfit <= r.limit else "larger than the noise"
    white = "white" if r.white >= BY_CHANCE else "not white"
    sentences = [f"The residuals are {size}, {r.misfit:.3g} sigma, and {white}."]
    rests = [name for name, x in answer.assumed.items() if (np.abs(ASSUMED_ERROR * x) > answer.total).any()]
    if rests:
        sentences.append(f"The values and their errors hold for {in_words(rests)} as in the scene.")
    if not answer.reasons:
        sentences.append("fitted.toml is the scene with these values; simulate, reduce and control accept it.")
    return sentences


def result_of(answer: Identified) -> dict[str, Any]:
    """The keys of ``result.json``."""
    return {
        "refused": list(answer.reasons),
        "warnings": list(answer.warnings),
        "values": {
            u.name: {
                "value": answer.values[i], "unit": u.unit, "start": answer.start[i], "noise": answer.noise[i],
                **{name: None if part is None else part[i] for name, part in answer.parts.items()},
                "together": answer.total[i],
            }
            for i, u in enumerate(answer.unknowns)
        },
        "parts": answer.kinds,
        "law": answer.law,
        "correlation": answer.correlation,
        "directions": [
            {"deviation": 1 / max(float(s), 1e-300), "of": dict(zip([u.name for u in answer.unknowns], d, strict=True))}
            for s, d in zip(answer.sensitivities, answer.directions, strict=True)
        ],
        "assumed": answer.assumed,
        "beside": [
            {"name": n.name, "value": n.value, "noise": n.noise, **n.parts, "together": n.total}
            for n in answer.nuisances
        ],
        "residuals": answer.residuals,
        "posterior": answer.posterior,
        "history": answer.history,
        "N": answer.N,
        "runs": answer.runs,
        "mesh": None if answer.estimate is None else {"estimate": answer.estimate.estimate, "n_e": answer.estimate.n_e},
    }  # fmt: skip
