"""What an effect costs: builds, factors, steps and memory of several scenes side by side.

Times are interleaved, so that the noise of the machine hits all scenes alike; work and memory are counted, not timed:
PETSc counts the operations of a step, and every matrix, vector and array that a run holds is added up.
"""

from __future__ import annotations

import gc
import re
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from softgrasp.fem import ITERATIVE, Array, Model, PETSc, Run, RunOptions, Scene, TissueMesh, build, digest
from softgrasp.fem.solve.differences import Differences, arrays_of
from softgrasp.study.effects.result import Cost, ZeroCostCheck
from softgrasp.study.effects.switch import neutral
from softgrasp.study.shell import RepeatableRun, interleave, medians, rotated

BURSTS = 7  # short ones make a sample by their median, so that a busy moment of the machine falls out
BURST_SECONDS = 0.02  # of the steps of one; long against the timer
SAMPLE_SECONDS = 0.15  # of the bursts of a sample: one with long steps needs fewer, for the moment falls out in them
BUILD_SECONDS = 3.0  # the builds are repeated at most about this long
MOST_STEPS = 20_000  # in one sample
STEPS = 10  # in which nothing may be created
OWN = "Viewer"  # made by the count itself
SCENE, AGAIN = "scene", "scene again"  # cases: as it is, before and after its effects are switched


@dataclass
class MeasuredScene:
    """One scene under measurement."""

    model: Model  # the last one built
    # samples of each stage: mesh, assembly, setup (factor and the drive's own solves), step
    seconds: dict[str, list[float]] = field(default_factory=dict)
    prints: dict[str, str] = field(default_factory=dict)  # hash of each operator, see `operator_hashes`
    bytes: dict[str, float] = field(default_factory=dict)  # memory of what the run holds, over all ranks [byte]
    flops: float = 0.0  # operations of PETSc in a step, over all ranks [1]
    # what PETSc's log counts as created by build, factor, start and the first step, by class
    objects: dict[str, int] = field(default_factory=dict)
    objects_in_steps: dict[str, int] = field(default_factory=dict)  # PETSc objects created by the next steps, by class
    mesh: TissueMesh | None = None  # shared with other scenes; None where each makes its own


def bare_output(scene: Scene) -> Scene:
    """The scene without snapshots: their memory and copies belong to no effect."""
    return scene.changed(lambda table: table["output"].update(snapshots="none"))


# --- hashes and memory


def operator_hashes(model: Model, run: Run) -> dict[str, str]:
    """Hash of pattern and values of every operator that the steps use, and of the hand's part. Collective."""
    system, comm = model.system, model.system.layout.comm
    matrices = {"M_ee": system.M_ee, "K_ee": system.K_ee, "S": run.midpoint.solver.S}
    if system.damping.matrix is not None:
        matrices["D_ee"] = system.damping.matrix
    arrays: dict[str, list[Array]] = {name: arrays_of(A) for name, A in matrices.items()}
    arrays |= {name: [getattr(system, name)] for name in ("T", "G", "M_hand", "M_rigid")}
    drive = getattr(run.drive, "drive", run.drive)  # without contact
    hand = (drive, getattr(drive, "step", None))
    arrays["hand"] = [getattr(part, name) for part in hand for name in ("c", "inverse", "GY") if hasattr(part, name)]
    return {name: "".join(comm.allgather(digest(*parts))) for name, parts in arrays.items()}


def matrix_memory(A: PETSc.Mat) -> float:
    """Values and indices of a sparse matrix over all ranks [byte]. Collective.

    Counted from its entries, for PETSc itself reports no memory in an optimised build.
    """
    if A.getType() == "python":
        return float(A.comm.tompi4py().allreduce(sum(array.nbytes for array in arrays_of(A))))
    integer = np.dtype(PETSc.IntType).itemsize
    entries = A.getInfo(PETSc.Mat.InfoType.GLOBAL_SUM)["nz_allocated"]
    block = A.getBlockSize() ** 2 if "baij" in A.getType() else 1
    return float(entries * (8 + integer / block) + integer * (A.getSize()[0] + 1))


def memory_by_object(model: Model, run: Run) -> dict[str, float]:
    """Memory of each matrix, vector and array that model and run hold, over all ranks [byte]. Collective.

    Found by looking through the objects, so that nothing an effect allocates can be forgotten. Views count once; what
    every rank holds for itself counts on each.
    """
    system, comm, midpoint = model.system, model.system.layout.comm, run.midpoint
    holders: list[tuple[str, Any]] = [("", system), ("", system.damping), ("step.", midpoint), ("hand.", run.drive)]
    holders.append(("hand.", getattr(getattr(run.drive, "drive", run.drive), "step", None)))
    contact = run.contact
    if contact is not None:
        holders += [("contact.", at) for at in (contact, contact.responses, contact.small, contact.table)]
        holders.append(("contact.surface.", contact.surface))
        holders.append(("contact.", getattr(contact.responses, "swept", None)))
        mass = getattr(getattr(contact.strike, "impulses", None), "mass", None)
        holders += [("contact.mass.", mass), ("contact.mass.kept.", getattr(mass, "kept", None))]
        holders.append(("contact.mass.", getattr(getattr(mass, "L", None), "arrays", None)))
    holders += [("step.", midpoint.operators), ("step.order.", midpoint.operators.order)]
    holders += [("points.", system.points), ("points.", getattr(midpoint, "body", None))]
    for layer in system.layers:
        holders += [(f"{key}[{layer.name}].", getattr(layer, key)) for key in ("K_mu", "K_lambda", "M_1")]
    product = getattr(midpoint, "K2", None)
    if isinstance(product, Differences):
        holders += [("step.K2.", {"sums": product.sums}), ("step.K2.above.", product.above)]
        holders.append(("step.K2.beside.", product.beside))
    held = [
        (prefix + name, value)
        for prefix, at in holders if at is not None
        for name, value in (at if isinstance(at, dict) else vars(at)).items()
    ]  # fmt: skip
    seen: set[int] = set()
    sizes: dict[str, float] = {}

    def everywhere(size: float, obj: PETSc.Object) -> float:
        return float(comm.allreduce(size)) if obj.comm.size < comm.size else size

    # arrays last, for some are views of vectors
    for name, value in sorted(held, key=lambda entry: isinstance(entry[1], np.ndarray)):
        if isinstance(value, PETSc.Mat) and value.handle not in seen:
            seen.add(value.handle)
            sizes[name] = everywhere(matrix_memory(value), value)
        elif isinstance(value, PETSc.Vec):
            seen.add(value.array_r.ctypes.data)
            sizes[name] = everywhere(8.0 * value.getSize(), value)
        elif isinstance(value, np.ndarray):
            new = value.ctypes.data not in seen or value.size == 0
            seen.add(value.ctypes.data)
            sizes[name] = sizes.get(name, 0.0) + float(comm.allreduce(value.nbytes * new))
    solver = midpoint.solver
    sizes["S"] = everywhere(matrix_memory(solver.S), solver.S)
    factored = solver.ksp.getOperators()[0]
    if factored.handle != solver.S.handle:
        sizes["S, factored"] = everywhere(matrix_memory(factored), factored)
    if solver.stars is not None:
        sizes["stars"] = sum(matrix_memory(A) for A in (*solver.stars.matrices[1:], solver.stars.P))
    if solver.name not in ITERATIVE and solver.S.comm.size == 1:  # factors spread over ranks are out of reach
        sizes["factor"] = everywhere(matrix_memory(solver.ksp.getPC().getFactorMatrix()), solver.S)
    return {name: size for name, size in sizes.items() if size > 0}


# --- times


def measure_builds(
    comm: MPI.Intracomm,
    scenes: dict[str, Scene],
    repeats: int,
    tick: Callable[[], None],
    mesh: TissueMesh | None = None,
) -> dict[str, MeasuredScene]:
    """Build and factor every scene in rotated order, ``repeats`` times or for `BUILD_SECONDS`. Collective."""
    cases: dict[str, MeasuredScene] = {}
    spent = 0.0

    def once(name: str) -> None:
        nonlocal spent
        model = build(scenes[name], comm=comm, mesh=mesh)
        with model.watch.stage("setup"):
            run = Run(model, RunOptions())
        case = cases.setdefault(name, MeasuredScene(model, mesh=mesh))
        for stage in ("mesh", "assembly", "setup"):
            case.seconds.setdefault(stage, []).append(model.watch.seconds[stage])
            spent += model.watch.seconds[stage]
        run.midpoint.destroy()
        tick()

    for i in range(repeats):
        gc.collect()
        for name in rotated(scenes, i):
            once(name)
        if comm.bcast(spent) > BUILD_SECONDS * (i + 1) / (i + 2):  # one round more would be too long
            break
    return cases


def measure_steps(comm: MPI.Intracomm, cases: dict[str, MeasuredScene], repeats: int, tick: Callable[[], None]) -> None:
    """Time the steps of all cases interleaved, then count their work, memory and hashes. Collective."""
    steppers = {name: RepeatableRun(case.model) for name, case in cases.items()}
    try:
        pace = {name: stepper.seconds_per_step(5) for name, stepper in steppers.items()}
        count = comm.bcast(int(np.clip(BURST_SECONDS / pace[SCENE], 5, MOST_STEPS)))
        samplers = {name: partial(stepper.seconds_per_step, count) for name, stepper in steppers.items()}
        bursts = comm.bcast({name: int(np.clip(SAMPLE_SECONDS / (count * s), 1, BURSTS)) for name, s in pace.items()})
        for _ in range(repeats):
            for name, seconds in medians(interleave(samplers, BURSTS, bursts)).items():
                cases[name].seconds.setdefault("step", []).append(seconds)
                tick()
        for name, case in cases.items():
            case.flops = steppers[name].flops()
            case.prints = operator_hashes(case.model, steppers[name].run)
            case.bytes = memory_by_object(case.model, steppers[name].run)
    finally:
        for stepper in steppers.values():
            stepper.destroy()


# --- objects


def created(comm: MPI.Intracomm) -> Counter[str]:
    """Objects created so far, by class, from the table "Object Type Creations" of PETSc's log on rank 0. Collective.

    The log counts from the first ``PETSc.Log.begin()`` of the process; numpy arrays are not in it.
    """
    with tempfile.TemporaryDirectory() as folder:
        name = comm.bcast(str(Path(folder) / "log.txt"))
        viewer = PETSc.Viewer().createASCII(name, "w", comm=comm)
        PETSc.Log.view(viewer)
        viewer.destroy()
        text = Path(name).read_text() if comm.rank == 0 else ""
        return Counter(comm.bcast(read_table(text)))


def read_table(text: str) -> dict[str, int]:
    """Class and number of creations from the text of PETSc's log."""
    counts: Counter[str] = Counter()
    table = f"\n{text}".partition("\nObject Type")[2].partition("\n===")[0]
    for name, creations in re.findall(r"^ *(\S.*?) +(\d+) +\d+ *$", table, re.MULTILINE):  # one row a stage
        if name != OWN and int(creations):
            counts[name] += int(creations)
    return dict(counts)


@contextmanager
def counting(comm: MPI.Intracomm) -> Iterator[dict[str, int]]:
    """Fills the dictionary with what is created inside. Collective."""
    PETSc.Log.begin()
    before, counts = created(comm), dict[str, int]()
    yield counts
    counts.update(created(comm) - before)


def objects_of(
    comm: MPI.Intracomm, scene: Scene, mesh: TissueMesh | None = None
) -> tuple[dict[str, int], dict[str, int]]:
    """Objects that PETSc's log sees created up to the first step of a run from rest, and in the next ones. Collective.

    The static solve of a start in equilibrium belongs to the start and no effect: gravity is tried with it, not before.
    Turns on PETSc's log, which takes a tenth of a short step: not before times are measured.
    """
    with counting(comm) as at_first:
        resting = scene.changed(lambda table: table["time"].update(start="rest"))
        stepper = RepeatableRun(build(resting, comm=comm, mesh=mesh))
        stepper.run.advance_to(stepper.ts, min(1, stepper.run.steps))
    with counting(comm) as in_steps:
        stepper.run.advance_to(stepper.ts, min(1 + STEPS, stepper.run.steps))
    stepper.destroy()
    return at_first, in_steps


# --- what an effect adds, and that one that is off adds nothing


def ends(samples: Array, share: float = 0.0) -> tuple[float, float]:
    """Smallest and largest sample, or the two with a share of the samples beyond."""
    low, high = np.quantile(samples, [share, 1 - share])
    return float(low), float(high)


def gaps(a: MeasuredScene, b: MeasuredScene, stage: str) -> Array:
    """Paired differences of the samples of a stage [s]."""
    difference: Array = np.array(a.seconds[stage]) - np.array(b.seconds[stage])
    return difference


def cost_of(with_: MeasuredScene, without: MeasuredScene, noise: dict[str, float]) -> Cost:
    """The differences of two cases; ``noise``: what the scene differs from itself by, the step as a share."""
    assembly, setup, step = (gaps(with_, without, stage) for stage in ("assembly", "setup", "step"))
    shares = step / np.array(without.seconds["step"])
    more, less = sum(with_.bytes.values()), sum(without.bytes.values())
    return Cost(
        assembly=float(np.median(assembly)),
        setup=float(np.median(setup)),
        assembly_range=ends(assembly),
        setup_range=ends(setup),
        assembly_noise=noise["assembly"],
        setup_noise=noise["setup"],
        step=float(np.median(step)),
        step_relative=float(np.median(shares)),
        step_low=float(shares.min()),
        step_high=float(shares.max()),
        step_noise=noise["step"],
        step_quartiles=ends(shares, 0.25),
        flops=with_.flops - without.flops,
        flops_relative=with_.flops / without.flops - 1 if without.flops else 0.0,
        memory=more - less,
        memory_relative=more / less - 1,
        holds=tuple(sorted(set(with_.bytes) - set(without.bytes))),
        objects=difference(with_.objects, without.objects),
    )


def difference(more: dict[str, int], less: dict[str, int]) -> dict[str, int]:
    """What the one has more, or less, of each class than the other."""
    return {name: d for name in sorted({*more, *less}) if (d := more.get(name, 0) - less.get(name, 0))}


def check_zero_cost(name: str, before: MeasuredScene, again: MeasuredScene) -> ZeroCostCheck:
    """Compare the scene before and after the effect was on in this process. Collective."""
    layout = before.model.system.layout
    prints, counts = [again.prints], [(again.objects, again.objects_in_steps)]
    with_zero = neutral(before.model.scene, name, layout.dimension)
    if with_zero is not None:
        model = build(with_zero, comm=layout.comm, mesh=before.mesh)
        run = Run(model, RunOptions())
        prints.append(operator_hashes(model, run))
        run.midpoint.destroy()
        if before.objects:
            counts.append(objects_of(layout.comm, with_zero, before.mesh))
    return ZeroCostCheck(
        same_operators=all(p == before.prints for p in prints),
        same_objects=not before.objects_in_steps and all(c == (before.objects, {}) for c in counts),
        same_work=again.flops == before.flops,
    )
