"""Bases of a scene beside each other from Python: errors, times and stability of each at every N, as labelled data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from numbers import Integral
from typing import TYPE_CHECKING, Any

import numpy as np

from softgrasp.fem.errors import SceneError, shortened
from softgrasp.fem.labelled import package, table
from softgrasp.fem.shown import Card, Shown, counted, drawn, listed, percent
from softgrasp.reduction.bases.registry import find_method
from softgrasp.reduction.replay import FullRun, as_full
from softgrasp.study.reduce.linear.measure import chosen_methods, sweep_all
from softgrasp.study.reduce.linear.result import POINT_UNITS, MethodSweep, Point, best

if TYPE_CHECKING:
    from softgrasp.fem.model.build import Model
    from softgrasp.fem.run.states.trajectory import Trajectory

NUMBERS = tuple(f.name for f in fields(Point) if f.name not in ("N", "split", "stable"))


@dataclass(frozen=True, repr=False)
class ReductionTable(Shown):
    """Errors, times and stability of several bases at several N, as in ``points.csv`` of ``softgrasp reduce``."""

    sweeps: tuple[MethodSweep, ...]
    """Every basis with its points, one for each N that it can have."""

    def card(self) -> Card:
        """Bases, N, the least error of a stable model, what was refused."""
        found = [(p, s) for s in self.sweeps if (p := best(s.points)) is not None]
        least, own = min(found, key=lambda each: each[0].error_deformation, default=(None, None))
        refused = sum(len(s.refused) for s in self.sweeps)
        unstable = sum(not p.stable for s in self.sweeps for p in s.points)
        text = "no stable model"
        if least is not None and own is not None:
            text = f"{percent(least.error_deformation)} of the deformation, {own.method.key} at N = {least.N}"
        rows = (
            ("bases", listed(s.method.key for s in self.sweeps)),
            ("N", listed(str(N) for N in self._sizes())),
            ("least error", text),
            ("models", f"{sum(len(s.points) for s in self.sweeps)}, of them {unstable} unstable"),
            ("refused", f"{counted(refused, 'size')} that a basis cannot have"),
        )
        return Card("Reduced models of several bases", rows)

    def _sizes(self) -> list[int]:
        return sorted({p.N for s in self.sweeps for p in s.points} | {N for s in self.sweeps for N in s.refused})

    def to_pandas(self) -> Any:
        """One row a basis and N, and the numbers of ``points.csv``, as ``pandas.DataFrame``. Not collective.

        Raises SoftgraspError: pandas is not installed.
        """
        names = ("N", *NUMBERS, "stable")
        return table(
            {"basis": s.method.key} | {name + POINT_UNITS.get(name, ""): getattr(p, name) for name in names}
            for s in self.sweeps
            for p in s.points
        )

    def to_xarray(self) -> Any:
        """The dimensions basis and N, as ``xarray.Dataset``. Not collective.

        A number is NaN, and ``stable`` False, where a basis cannot have this N; units are in ``attrs["units"]``.

        Raises SoftgraspError: xarray is not installed.
        """
        xarray, sizes = package("xarray"), self._sizes()
        data: dict[str, Any] = {}
        for name in (*NUMBERS, "stable"):
            values = np.full((len(self.sweeps), len(sizes)), False if name == "stable" else np.nan)
            for i, s in enumerate(self.sweeps):
                for p in s.points:
                    values[i, sizes.index(p.N)] = getattr(p, name)
            unit = POINT_UNITS.get(name, "").strip(" []") or "1"
            data[name] = (("basis", "N"), values, {} if name == "stable" else {"units": unit})
        return xarray.Dataset(data, {"basis": [s.method.key for s in self.sweeps], "N": sizes})

    def plot(self) -> Any:
        """Error of the deformation against N, dotted where a model is unstable, as ``matplotlib`` figure."""
        return drawn("table_errors", self.sweeps)


def compare_bases(
    model: Model,
    run: Trajectory | FullRun,
    methods: Sequence[str] | None = None,
    N: Sequence[int] | None = None,
) -> ReductionTable:
    """|X - X_r| / |X| [SBRH21], times and stability of reduced models of several bases at several N. Collective.

    >>> import softgrasp as sg
    >>> model = sg.build("paper_forward", ["tissue.cells=[4, 8]", "time.steps=100"])
    >>> table = sg.compare_bases(model, sg.simulate(model), ["psd_fixed", "craig_bampton"], N=[14, 20])
    >>> [(s.method.key, s.points[-1].error_deformation < s.points[0].error_deformation) for s in table.sweeps]
    [('psd_fixed', True), ('craig_bampton', True)]

    Args:
        model: scene with linear elasticity, without obstacles and ``effects.frame``.
        run: a full run of it, with its snapshots in memory.
        methods: names of bases, see :func:`softgrasp.reduction.reduce.reduce`; None: those of ``reduction.methods``,
            else the paper's six, further ones, and those of ``reduction.plugins``.
        N: dimensions, the hand's 2 n_s included; None: those of ``reduction.N``.

    Returns:
        The table, with ``to_pandas``, ``to_xarray`` and ``plot``.

    Raises:
        SceneError: the scene has other models, see above, N is no list of positive whole numbers, or the run kept no
            snapshots or is at rest.
        BasisError: a name is unknown.
        SolverError: a factorisation failed.
    """
    scene = model.scene
    scene.refuse_contact("sg.compare_bases")
    scene.refuse_frame("sg.compare_bases")
    if model.system.points is not None:
        raise SceneError(
            f"scene {scene.name} has effects.finite_strain, whose models have one basis, so that there is nothing to "
            "compare; softgrasp.reduce(model, run, N=N) makes it"
        )
    if isinstance(methods, str):
        raise SceneError(f"methods = {shortened(repr(methods))} must be a list, as in [{shortened(repr(methods))}]")
    names = chosen_methods(scene) if methods is None else tuple(methods)
    for name in names:
        find_method(name)
    options = scene.reduction
    if N is not None:
        sizes = [n for n in N if isinstance(n, Integral) and n >= 1] if np.iterable(N) else []
        if not sizes or len(sizes) < len(list(N)):
            raise SceneError(f"N = {shortened(repr(N))} must be a list of positive whole numbers, as in [14, 30]")
        options = options.model_copy(update={"N": sorted({int(n) for n in sizes})})
    return ReductionTable(sweep_all(names, as_full(model, run), lambda *_: None, options))
