"""What ``softgrasp control`` finds of an observer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from softgrasp.fem.petsc import Array
from softgrasp.lqr.design.observer import ObservedControl
from softgrasp.lqr.observer.seen import Seen


@dataclass(frozen=True)
class ObservedStudy:
    """The observer of a scene, and what a tick of it takes."""

    observed: ObservedControl  # sensors, filters and judgement
    tick: float  # time of one tick of the controller with observer, median [s]
    sd_nodes: Array | None  # least, median and largest deviation at the nodes by the full filter [m], (3,)
    names: tuple[str, ...]  # of the outputs

    def result(self) -> dict[str, Any]:
        """The key "observer" of ``result.json``."""
        found, judged, own = self.observed, self.observed.judged, self.observed.reduced
        full, seen = found.full, found.seen
        modes = [] if seen is None else [seen_mode(seen, i) for i in range(len(seen.modes))]
        return {
            "N": own.plant.N,
            "samples": list(found.sensors.names),
            "marker_nodes": [list(node) for node in found.sensors.nodes],
            "sd_samples": found.sensors.sd.tolist(),
            "sd_left_out": np.sqrt(own.left_out).tolist(),
            "weight_left_out": found.weight,
            "modes": modes,
            "delay": own.filter.delay,
            "period": found.controller.period,
            "abscissa": judged.abscissa,
            "modes_kept": None if found.loop.complete else len(found.loop.plant.omega),
            "small_gain": judged.small_gain,
            "abscissa_known": judged.abscissa_known,
            "abscissa_without": found.without,
            "cost_rate": judged.cost,
            "cost_rate_known": judged.cost_known,
            "cost_excess": judged.excess,
            "sd_outputs": judged.sd_outputs.tolist(),
            "sd_estimate": judged.sd_error.tolist(),
            "sd_full": None if found.sd_full is None else found.sd_full.tolist(),
            "sd_nodes_full": None if self.sd_nodes is None else self.sd_nodes.tolist(),
            "residual": None if full is None else full.solution.residual,
            "rank": None if full is None else full.solution.rank,
            "solves": None if full is None else full.solution.counts["solves"],
            "time_tick": self.tick,
        }


def seen_mode(seen: Seen, i: int) -> dict[str, Any]:
    """One mode of the filter: number from 1, share of its largest motion that every marker makes, what hides it."""
    hidden = float(seen.hidden[i])
    return {
        "mode": int(seen.modes[i]) + 1,
        "frequency": float(seen.frequency[i]),
        "share": dict(zip(seen.names, seen.share[:, i].tolist(), strict=True)),
        "not_seen_by": seen.blind(i),
        "hidden": hidden if np.isfinite(hidden) else None,
    }
