"""What the engines of a reduced basis cost and how far they are right: ``python -m benchmarks bases``."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from mpi4py import MPI
from numpy.typing import NDArray

from benchmarks import driver
from benchmarks.driver import Failure, Goal
from softgrasp.fem.petsc import Array, total
from softgrasp.reduction.bases.engines import factor, small_svd
from softgrasp.study.shell.timing import interleave, medians, timed

SIZES = "10000x600,100000x600"
KEPT = 60  # basis vectors that are made
CHUNK = 2_000  # rows in extended precision at a time
DECADES = 16  # of singular values, evenly spread
RIGHT, ROUGH = 1e-8, 0.1  # relative errors of a singular value
GOAL = 1e-10  # sigma / sigma_1 down to which the default has to be right
SCALAPACK_LIMIT = 20_000  # rows; minutes beyond
NUMPY_LIMIT = 200_000
TITLES = {
    "tsqr": "POD, SLEPc BV TSQR (default)",
    "svd": "POD, SLEPc SVD trlanczos, leading 60",
    "svd_all": "POD, SLEPc SVD scalapack, all",
    "gram": "POD, Gram (method of snapshots)",
    "numpy": "POD, numpy.linalg.svd",
    "psd_tsqr": "PSD complex SVD, SLEPc BV TSQR (default)",
    "psd_gram": "PSD complex SVD, Gram",
    "psd_numpy": "PSD complex SVD, numpy.linalg.svd",
}
HELP = f"""Measure the engines that factor snapshots: seconds beside accuracy, in one table.

The matrix is made with known singular values, {DECADES} decades evenly spread, as m columns for POD and as m / 2
complex columns q + i p for PSD. Every size and rank count is a program of its own under mpiexec; in it the engines
take turns and the median counts. Columns: seconds for singular values and {KEPT} vectors; sigma / sigma_1 down to which
all that are computed are right to {RIGHT:g}, and to {ROUGH:g}; largest entry of U' U - I. numpy.linalg.svd of the whole
matrix stands beside them on one rank.

Keep the machine quiet while it runs. A fast look: --sizes 2000x100 --ranks 1 --repeats 3."""


COLUMNS = {
    "engine": "title", "rows": "rows", "columns": "columns", "ranks": "ranks", "s": "seconds .3g",
    "/ default": "slower .2f", f"right to {RIGHT:g}": "right .0e", f"to {ROUGH:g}": "rough .0e",
    "|U'U - I|": "orthonormality .0e",
}  # fmt: skip
CSV = {name: name for name in ("engine", "rows", "columns", "ranks", "seconds", "right", "rough", "orthonormality")}


@dataclass(frozen=True)
class EnginePoint:
    """One engine at one size."""

    engine: str
    rows: int
    columns: int
    ranks: int
    # right, rough: sigma / sigma_1 down to which all values are right to these tolerances
    right: float
    rough: float
    orthonormality: float  # largest entry of U' U - I
    seconds: float  # median
    slower: float  # over the seconds of the default
    samples: list[float]

    @property
    def title(self) -> str:
        """The engine in words."""
        return TITLES[self.engine]


def parse_shapes(text: str) -> list[tuple[int, int]]:
    """``10000x600`` as pairs of rows and columns. Raises typer.BadParameter: anything else."""
    advice = "shape; write 10000x600 with at least 4 columns and more rows"
    shapes = [(int(n), int(m)) for n, m in driver.parse_list(text, r"(\d+)x(\d+)", advice)]
    for n, m in shapes:
        if not n >= m >= 4:
            raise typer.BadParameter(f"'{n}x{m}' is no {advice}")
    return shapes


def spectrum_of(m: int) -> Array:
    """Singular values from 1 to 10^-DECADES."""
    return 10.0 ** (-DECADES * np.arange(m) / (m - 1))


def known_matrix(comm: MPI.Intracomm, n: int, m: int, complex_valued: bool) -> NDArray[Any]:
    """U diag(sigma) C^H with known sigma: U are cosines, orthonormal on n points, C mixes all columns. F order.

    It is made in extended precision and rounded once: a product in double precision alone would change
    sigma = 1e-10 in its eighth digit. Every rank makes its own rows.
    """
    start, stop = n * comm.rank // comm.size, n * (comm.rank + 1) // comm.size
    X = np.empty((stop - start, m), dtype=complex if complex_valued else float, order="F")
    j, wide = np.arange(1, m + 1), np.longdouble
    turn = 2 * np.arccos(wide(-1)) / (4 * n)
    sigma = wide(10) ** (-DECADES * np.arange(m, dtype=wide) / (m - 1))
    for first in range(start, stop, CHUNK):
        i = np.arange(first, min(first + CHUNK, stop))[:, None]
        # whole turns go first, in integers
        rows = np.sqrt(wide(2) / n) * np.cos(turn * ((2 * i + 1) * j % (4 * n)).astype(wide)) * sigma
        real, imaginary = rows, np.zeros_like(rows)
        random = np.random.default_rng(0)
        for _ in range(3):  # reflections I - 2 w w^H
            a, b = random.standard_normal((2, m)).astype(wide)
            b = b if complex_valued else np.zeros_like(b)
            factor_2 = 2 / (np.sum(a * a) + np.sum(b * b))
            x = (factor_2 * (real * a - imaginary * b).sum(axis=1))[:, None]
            y = (factor_2 * (real * b + imaginary * a).sum(axis=1))[:, None]
            real, imaginary = real - (x * a + y * b), imaginary - (y * a - x * b)
        X[first - start : first - start + len(i)] = real + 1j * imaginary if complex_valued else real
    return X


def right_down_to(sigma: Array, true: Array, tolerance: float) -> float:
    """Smallest sigma / sigma_1 down to which all values are right to a relative tolerance."""
    k = min(len(sigma), len(true))
    wrong = np.abs(sigma[:k] / true[:k] - 1) > tolerance
    count = int(np.argmax(wrong)) if wrong.any() else k
    return float(true[count - 1] / true[0]) if count else float("inf")


SingularPair = tuple[Array, NDArray[Any]]  # all sigma, leading columns of U


def methods_for(comm: MPI.Intracomm, n: int, m: int) -> dict[str, tuple[Callable[[], SingularPair], Array]]:
    """Every engine as a call that returns sigma and local U, with the true singular values. Collective."""
    X = known_matrix(comm, n, m, False)
    half = known_matrix(comm, n, m // 2, True)
    beside = np.asfortranarray(np.hstack([half.real, half.imag]))

    def pod(engine: Any, k: int | None = None) -> SingularPair:
        f = factor(comm, X, engine, k)
        u, s, _ = small_svd(comm, f.R)
        return f.scale * s, f.Q @ u[:, :KEPT]

    def psd(engine: Any) -> SingularPair:
        f = factor(comm, beside, engine)
        u, s, _ = small_svd(comm, f.R[:, : m // 2] + 1j * f.R[:, m // 2 :])
        return f.scale * s, f.Q @ u[:, :KEPT]

    def peer(A: NDArray[Any]) -> SingularPair:
        u, s, _ = np.linalg.svd(A, full_matrices=False)
        return s, u[:, :KEPT]

    true, true_half = spectrum_of(m), spectrum_of(m // 2)
    result: dict[str, tuple[Callable[[], SingularPair], Array]]
    result = {name: (partial(pod, name), true) for name in ("tsqr", "gram")}
    result["svd"] = partial(pod, "svd", min(KEPT, m // 3 - 1)), true
    if n <= SCALAPACK_LIMIT:
        result["svd_all"] = partial(pod, "svd"), true
    result |= {f"psd_{name}": (partial(psd, name), true_half) for name in ("tsqr", "gram")}
    if comm.size == 1 and n <= NUMPY_LIMIT:
        result |= {"numpy": (partial(peer, X), true), "psd_numpy": (partial(peer, half), true_half)}
    return result


def measure(n: int, m: int, repeats: int, comm: MPI.Intracomm = MPI.COMM_WORLD) -> list[EnginePoint]:
    """One size on this many ranks: seconds, accuracy and orthonormality of every engine. Collective."""
    methods = methods_for(comm, n, m)
    accuracy = {}
    for name, (call, true) in methods.items():
        sigma, U = call()  # also warms up
        gram = total(comm, np.array([(U.conj().T @ U).real, (U.conj().T @ U).imag]))
        defect = float(np.abs(gram[0] + 1j * gram[1] - np.eye(U.shape[1])).max())
        accuracy[name] = right_down_to(sigma, true, RIGHT), right_down_to(sigma, true, ROUGH), defect
    samples = interleave({name: partial(timed, comm, call) for name, (call, _) in methods.items()}, repeats)
    seconds = medians(samples)
    default = {name: seconds["psd_tsqr" if name.startswith("psd") else "tsqr"] for name in methods}
    return [
        EnginePoint(name, n, m, comm.size, *numbers, seconds[name], seconds[name] / default[name], samples[name])
        for name, numbers in accuracy.items()
    ]


def goals(points: Sequence[EnginePoint]) -> list[Goal]:
    """How far down the defaults are right; the goal is the last value of the spectrum above ``GOAL``."""
    result = []
    for p in points:
        if p.engine in ("tsqr", "psd_tsqr"):
            sigma = spectrum_of(p.columns if p.engine == "tsqr" else p.columns // 2)
            text = f"{p.title}, {p.rows} x {p.columns}, {p.ranks} rank(s): right to {RIGHT:g} down to sigma / sigma_1"
            result.append(Goal(text, p.right, 1.001 * float(sigma[sigma >= GOAL].min())))  # room for rounding
    return result


def main(
    sizes: Annotated[str, typer.Option(help="rows x columns")] = SIZES,
    ranks: driver.Ranks = "1,2",
    repeats: driver.Repeats = 3,
    out: Annotated[Path, typer.Option(help="folder for bench_bases.json and bench_bases.csv")] = Path("out"),
) -> None:
    """See HELP."""
    shapes, counts = parse_shapes(sizes), driver.parse_ranks(ranks)
    console, rows = driver.open_console(130), list[EnginePoint | Failure]()
    for (n, m), k in itertools.product(shapes, counts):
        spec = {"n": n, "m": m, "repeats": repeats}
        rows += driver.measure(console, EnginePoint, "bases", spec, k, f"{n} x {m}")
    points, failed = driver.of(EnginePoint, rows), driver.failures(rows)
    console.print(driver.table_of(points, COLUMNS, f"factoring snapshots: {KEPT} vectors, median seconds").terminal())
    driver.show_goals(console, goals(points))
    content = {"command": "bench_bases", "rows": points, "failed": failed}
    content |= {"goals": driver.goal_rows(goals(points))}
    files = driver.write_bench(out, "bench_bases", content, driver.table_of(points, CSV))
    driver.list_bench(console, files, failed)
    if not all(goal.ok for goal in goals(points)):
        raise typer.Exit(1)
