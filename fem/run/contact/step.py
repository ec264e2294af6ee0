"""The exact midpoint step with contact behind it."""

from __future__ import annotations

from softgrasp.fem.errors import SceneError
from softgrasp.fem.model.build import Model
from softgrasp.fem.model.surface import refuse_within
from softgrasp.fem.obstacles.compiled import contact_library
from softgrasp.fem.run.contact.flat import FlatContact
from softgrasp.fem.run.contact.general import Contact
from softgrasp.fem.run.contact.touching import Touching
from softgrasp.fem.run.hand import HandStep
from softgrasp.fem.run.midpoint import TissueMidpoint, TissueState
from softgrasp.fem.run.motion import ForceDrive, TableDrive


class ContactDrive:
    """A drive whose step without contact is corrected.

    Attributes:
        q: displacement of the hand at each time, the array of the drive, (steps + 1, n_s) [m, rad].
        v: velocity of the hand at each time, the same, (steps + 1, n_s) [m/s, rad/s].
        c: coefficients of the load G c of each step, the same, (steps, n_s).
        u: force on the hand in each step, the same, (steps, n_s) [N, N m].
    """

    def __init__(self, drive: TableDrive | ForceDrive, contact: Contact) -> None:
        self.drive, self.contact = drive, contact
        self.q, self.v, self.c, self.u = drive.q, drive.v, drive.c, drive.u

    def solve(self, n: int, midpoint: TissueMidpoint, state: TissueState) -> None:
        """One step. Collective."""
        self.contact.lead()
        self.drive.solve(n, midpoint, state)
        self.contact.press(n, self.drive)

    def check(self, begin: int, end: int) -> None:
        """Check the steps from begin to end.

        Raises SolverError: see `ForceDrive.check`, or the hand itself met an obstacle.
        """
        self.drive.check(begin, end)
        if isinstance(self.drive, ForceDrive):
            self.contact.check_hand(self.drive.q, begin, end)


class ContactMidpoint(Touching):
    """The linear step; ``contact`` acts at its end."""


def make_contact(
    model: Model, midpoint: TissueMidpoint, drive: TableDrive | ForceDrive, steps: int
) -> tuple[ContactDrive, Contact]:
    """The contact of a run, and its drive with it. Collective.

    Raises SoftgraspError: a path of an obstacle does not fit, or an obstacle is in the tissue or meets the hand.
    """
    hand = drive.step if isinstance(drive, ForceDrive) and model.system.two_way else None
    contact = begin_contact(model, midpoint, steps, hand)
    if isinstance(drive, TableDrive):
        contact.check_hand(drive.q, 0, steps + 1)
    q = drive.q[0]
    refuse_within(model.space, contact.obstacles, contact.surface.places(q), q[: contact.d])
    return ContactDrive(drive, contact), contact


def begin_contact(model: Model, midpoint: TissueMidpoint, steps: int, hand: HandStep | None) -> Contact:
    """The contact that acts on the steps of a midpoint from now on; ``hand``: see `Contact`. Collective.

    Raises SceneError: a path of an obstacle does not fit, or the hand holds all of the boundary.
    """
    contact = _contact_of(model, midpoint, steps, hand)
    if not contact.p:
        raise SceneError(
            "every node of the boundary lies in the contact zone, and none can touch an obstacle; make [contact] "
            "smaller or set effects.obstacles = false"
        )
    return contact


def _contact_of(model: Model, midpoint: TissueMidpoint, steps: int, hand: HandStep | None) -> Contact:
    assert isinstance(midpoint, Touching)
    obstacles = model.scene.obstacle or []
    kind: type[Contact] = Contact
    if model.system.points is not None:
        from softgrasp.fem.run.contact.finite import FiniteContact  # only scenes with finite strain pay for it

        midpoint.contact = FiniteContact(model, midpoint, steps, hand)
        return midpoint.contact
    flat = {entry.kind for entry in obstacles} == {"halfspace"} and contact_library() is not None
    if any(entry.friction for entry in obstacles):
        from softgrasp.fem.run.contact import friction  # only scenes with friction pay for it

        kind = friction.FlatFriction if flat else friction.FrictionContact
    elif flat:
        kind = FlatContact
    midpoint.contact = kind(model, midpoint, steps, hand)
    return midpoint.contact
