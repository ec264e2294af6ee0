"""The exact midpoint step with contact behind it."""

from __future__ import annotations

from softgrasp.fem.model.build import Model
from softgrasp.fem.obstacles.compiled import contact_library
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.contact.flat import FlatContact
from softgrasp.fem.run.contact.general import Contact
from softgrasp.fem.run.midpoint import TissueMidpoint, TissueState
from softgrasp.fem.run.motion import ForceDrive, TableDrive


class ContactDrive:
    """A drive whose step without contact is corrected; the histories are those of the drive."""

    def __init__(self, drive: TableDrive | ForceDrive, contact: Contact) -> None:
        self.drive, self.contact = drive, contact
        self.q, self.v, self.c, self.u = drive.q, drive.v, drive.c, drive.u

    def solve(self, n: int, midpoint: TissueMidpoint, state: TissueState) -> None:
        """One step. Collective."""
        self.drive.solve(n, midpoint, state)
        self.contact.press(n, self.drive)

    def check(self, begin: int, end: int) -> None:
        """Look at the steps taken. Raises SolverError: see `ForceDrive.check`, or the hand itself met an obstacle."""
        self.drive.check(begin, end)
        if isinstance(self.drive, ForceDrive):
            self.contact.check_hand(self.drive, begin, end)


class ContactMidpoint(TissueMidpoint):
    """The tissue half of the step; ``contact`` acts at its end."""

    contact: Contact

    def advance(self, old: TissueState, new: TissueState) -> None:
        """Write the new state, carry k and r on, and stop what is pressed. Collective."""
        super().advance(old, new)
        self.contact.finish(new)

    def restart_arrays(self) -> dict[str, Array]:
        """Further arrays of a restart file: the record and the set of pressed nodes."""
        return self.contact.restart_arrays()

    def restore(self, rows: Array | None, numbers: Array | None) -> None:
        """Continue with what `restart_arrays` returned, after `adopt`. Collective."""
        if rows is not None and numbers is not None:
            self.contact.restore(rows, numbers)

    def destroy(self) -> None:
        """Free all PETSc objects. Collective."""
        self.contact.destroy()
        super().destroy()


def make_contact(
    model: Model, midpoint: TissueMidpoint, drive: TableDrive | ForceDrive, steps: int
) -> tuple[ContactDrive, Contact]:
    """The contact of a run, and its drive with it. Collective.

    Raises SoftgraspError: a path of an obstacle does not fit, or the prescribed hand itself meets an obstacle.
    """
    assert isinstance(midpoint, ContactMidpoint)
    hand = drive.step if isinstance(drive, ForceDrive) and model.system.two_way else None
    obstacles = model.scene.obstacle or []
    kind: type[Contact] = Contact
    if any(entry.friction for entry in obstacles):
        from softgrasp.fem.run.contact.friction import FrictionContact  # only scenes with friction pay for it

        kind = FrictionContact
    elif {entry.kind for entry in obstacles} == {"halfspace"} and contact_library() is not None:
        kind = FlatContact
    midpoint.contact = kind(model, midpoint, steps, hand)
    if isinstance(drive, TableDrive):
        midpoint.contact.check_hand(drive, 0, steps + 1)
    return ContactDrive(drive, midpoint.contact), midpoint.contact
