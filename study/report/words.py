"""What the short words of a page mean; a page lists those that it uses."""

from __future__ import annotations

import re
from collections.abc import Sequence

WORDS = {
    "N": "columns of the basis V of a reduced model, those of the hand included; states of the reduced equation",
    "n_s": "degrees of freedom of the hand: its translations, and its turns where rotation is on",
    "n_e": "displacements of the tissue that are free: the nodes that the hand does not hold, times the dimension",
    "2n": "states of the full model: positions and velocities of hand and tissue, 2 (n_s + n_e)",
    "gate": "the number that decides whether an effect matters: above the stated value it does",
    "energy drift": "change of the energy that no work or damping explains, over the largest energy of the run",
    "residual": "what is left of an equation when its solution is put in, relative to its terms",
    "abscissa": "largest real part of the poles [1/s]; the motion decays where it is negative",
    "spectral radius": "largest modulus of the poles from tick to tick; the sampled motion decays where it is below 1",
    "excess cost": "cost of a reduced gain over that of the optimal one, minus 1",
    "ARE": "the algebraic Riccati equation, whose solution P gives the optimal gain K",
    "a priori": "a basis chosen from the model alone, before any large equation is solved",
    "fixed": "fixed solid modes: the hand keeps columns of its own in the basis and is not reduced",
    "offline": "work done once, before the first reduced run: snapshots, basis, projection",
    "online": "the steps of a reduced run",
    "deformation": "displacement of the tissue relative to the rigid motion of the hand",
    "snapshot": "the state of the full run at one instant, of which bases are built",
    "box": "the range of lambda and mu that a model was trained for",
    "proved": "not exceeded, up to rounding; what is estimated is about so large",
    "tick": "one period of the controller: it measures, computes and holds a force",
}


def words_of(text: str) -> Sequence[tuple[str, str]]:
    """The words that a text uses, with their meaning."""
    return [(word, meaning) for word, meaning in WORDS.items() if re.search(rf"(?<!\w){re.escape(word)}(?!\w)", text)]
